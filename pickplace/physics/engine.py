"""The protocol of physics engines, which carry out plans."""

from collections.abc import Collection, Iterable, Iterator
from typing import Protocol, runtime_checkable

from omegaconf import DictConfig

from pickplace.common.validate import refuse_if
from pickplace.config.registry import build
from pickplace.physics.plans import EpisodePlan
from pickplace.views.motion import Outcome


@runtime_checkable
class Engine(Protocol):
    """Engine that carries out the plans of episodes. The arguments of its class are the keys of its config.

    Attributes:
        name: its name in tables and in ``evaluation.json``.
        grips: whether it carries items from the bin with a gripper; optional.
    """

    name: str

    def carry_out(self, plans: Iterable[EpisodePlan], record: Collection[int] = ()) -> Iterator[Outcome]:
        """Yield the outcome of each plan, in order; it includes the motion for the episodes in ``record``."""
        ...


def build_engine(node: DictConfig) -> Engine:
    """Build the engine of a config of the group ``physics``.

    Raises:
        ValueError: for settings that make no sense, or a class that is no engine.
    """
    engine = build("physics", node)
    refuse_if(
        not isinstance(engine, Engine),
        f"physics._target_={node._target_}: no physics engine; expected name and carry_out(plans, record).",
    )
    return engine
