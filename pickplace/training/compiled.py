"""The compiled forms of the two parts of a collector: the acting policy, and the environment."""

from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import Compose, TransformedEnv

from pickplace.common.graphs import CompileSettings, Work
from pickplace.envs.torchrl import PickPlaceEnv
from pickplace.training.curriculum.transform import ToteHeightCurriculum


class CompiledPolicy(TensorDictModuleBase):
    """An acting policy whose work is compiled in the process that calls it first.

    Args:
        policy: reads and writes TensorDicts ``[N]``, always with the same ``N``.
        settings: how it is compiled.
    """

    def __init__(self, policy: TensorDictModuleBase, settings: CompileSettings):
        super().__init__()
        self.policy, self.settings = policy, settings
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys
        self._compiled: Work | None = None

    def forward(self, frames: TensorDictBase) -> TensorDictBase:
        if self._compiled is None:
            self._compiled = self.settings.network(self._act, "the acting policy")
        return frames.update(self._compiled({key: frames[key] for key in self.in_keys}))

    def _act(self, entries: dict[str, Tensor]) -> dict[str, Tensor]:
        frames = self.policy(TensorDict(entries, next(iter(entries.values())).shape[:1]))
        return {key: frames[key] for key in self.out_keys}


class CapturedEnv(TransformedEnv):
    """A training environment whose step, with the resets that follow it, is one captured piece of work.

    It returns the same as TorchRL's ``step_and_maybe_reset``. The levels of new episodes are drawn on the CPU in every
    step, because the captured work cannot say whether an episode has ended. Its state must not be loaded after a step:
    captured work keeps the addresses of the masks.

    Args:
        env: the environment.
        levels: the curriculum.
        settings: how the work is compiled.
    """

    def __init__(self, env: PickPlaceEnv, levels: ToteHeightCurriculum, settings: CompileSettings):
        super().__init__(env, Compose(levels))
        self._compiled = settings.steps(self._advance, "the environment")

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        state = super().reset(tensordict, **kwargs)
        # Copies: captured work writes into the environment's own masks.
        return state.update({key: value.clone() for key, value in state.items() if key.endswith("_mask")})

    def step_and_maybe_reset(self, tensordict: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        settings = self.transform[0].draw(self.batch_size)
        result = self._compiled({"action": tensordict["action"], **settings})
        entries = {part: TensorDict(result[part], self.batch_size, self.device) for part in ("next", "root")}
        return tensordict.set("next", entries["next"]), entries["root"]

    def _advance(self, entries: dict[str, Tensor]) -> dict:
        """Make a step and reset the problems that are done.

        Returns:
            The result of the step (``next``), and the observation from which the next one starts (``root``).
        """
        after = self.base_env._step(TensorDict({"action": entries["action"]}, self.batch_size))
        settings = {key: value for key, value in entries.items() if key != "action"}
        start = self.base_env._reset(TensorDict({"_reset": after["done"], **settings}, self.batch_size))
        return {"next": dict(after.items()), "root": dict(start.items())}
