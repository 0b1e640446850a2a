"""Short names of everything that a config or a checkpoint may name, and how it is made."""

from omegaconf import DictConfig

from pickplace.runs import hydra_app


def build(place: str, node: DictConfig, **kwargs):
    """Make the object that a config node names.

    Args:
        place: the node's place in the config, such as ``"planner"`` or ``"curriculum.advance"``.
        node: the settings, with a ``_target_``.
        **kwargs: arguments handed over as they are.
    """
    return hydra_app.instantiate(node, **kwargs)


def find(place: str, node: DictConfig):
    """Return the class or function that a config node names."""
    import hydra

    return hydra.utils.get_object(node._target_)
