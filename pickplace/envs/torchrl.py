"""The environment: one TorchRL ``EnvBase`` that simulates a batch of bins and totes as tensors."""

from collections.abc import Collection, Mapping
from dataclasses import replace

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Binary, Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from pickplace.common.capture import any_of, is_capturing
from pickplace.common.machine import usable_device
from pickplace.common.validate import check_bytes, expect, one_of, or_null, refuse_if, whole_number
from pickplace.envs.checks import check_items, check_numbers, check_samples, most_items, problem_bytes, require
from pickplace.envs.episode import RESET_ENTRIES, SETTINGS
from pickplace.envs.masks import MASKS, MaskMaker
from pickplace.items.arrival import coming_items, refill
from pickplace.items.distributions import MAX_SEED, PAPER_KINDS, STREAMS, ItemDistribution, Kinds, check_seed
from pickplace.items.tipping import check_tipping, longest_side, sizes_in_bin
from pickplace.rules.bin import may_arrive, remove_item
from pickplace.rules.cell import CELL_SETTINGS, cell_from_settings
from pickplace.rules.item import ALL_TURNS, Item
from pickplace.rules.observation import Term, check_terms, observe, standard_terms
from pickplace.rules.pile import Pile
from pickplace.rules.state import EMPTY, EpisodeSettings, Failure, State
from pickplace.rules.step import apply

DONE_KEYS = ("done", "terminated", "truncated")


class PickPlaceEnv(EnvBase):
    """Pick an item from a bin and place it in a tote, in one action, until nothing more fits.

    ``num_envs`` independent problems advance together as one TensorDict of ``batch_size=[num_envs]``.

    Action space:
        ``action``, int64 ``[N]``: the flat index of (pick cell, place cell, rotation) in ``[0, N_a)``,
        ``(((x_B * D_B + y_B) * W_T + x_T) * D_T + y_T) * R + r``.

    Observation space:
        * ``bin_depth``, float32 ``[N, W_B, D_B]``: height above the bin's floor, 0 where empty.
        * with ``bin_items`` above 1: ``bin_labels``, float32 ``[N, W_B, D_B]``: number of the item on each cell, from 1
          in the order of arrival, 0 where empty; and ``items``, int64 ``[N, M, 5]``: their x, y, w, d, h, or zeros.
        * with ``preview``: ``coming``, int64 ``[N, p, 5]``: x, y, w, d, h of the items that arrive next, in their
          order, or zeros; with ``handling`` ``[N, p, 8]``, as below.
        * ``tote_depth``, float32 ``[N, W_T, D_T]``: remaining height, ``H_T - height``.
        * ``tote_bearing``, float32 ``[N, W_T, D_T]``: 1 where the cell bears weight; all 1 unless ``support=bearing``.
        * ``tote_height``, int64 ``[N, 1]``: ``H_T`` of the running episode.
        * with ``handling``: ``handling``, int64 ``[N, M, 3]``, the turns that each item allows (bit ``r`` for rotation
          ``r``), its mass, and the greatest load on it, grams; and the pile in the tote of up to ``L`` items:
          ``tote_labels``, int64 ``[N, W_T, D_T]``, number of the item on each cell, from 1, 0 for the floor;
          ``pile_spare``, int64 ``[N, L]``, the mass that each still bears; ``pile_below``, bool ``[N, L, L]``, whether
          the second item lies below the first, or is the same.
        * with ``support=pct``: ``tote_boxes``, int64 ``[N, L, 6]``: x, y, z, w, d, h of the items in the tote.
        * with ``varies``: ``rotations``, bool ``[N, R]``; int64 ``[N, 1]``: ``item_mix``, ``bin_items``, ``refill``,
          ``preview`` and ``level``.
        * further terms, see ``observation``.
        * ``action_mask``, bool ``[N, N_a]``: True exactly where the action would succeed.
        * ``footprint_mask``, bool ``[N, M * Q * W_T * D_T]``, only if ``masks`` names it: the distinct
          ``(item, quarter_turned, x, y)`` that some action reaches; ``corner_mask`` likewise: those of them in corners.
        * ``occupancy``, float32 ``[N, 1]``: volume placed / volume of the tote.

    Rewards:
        The volume placed, in cells times height units, float32 ``[N, 1]``; 0 for a failed action.

    Starting state:
        An empty tote. Its height is ``tote_height`` (int64 ``[N, 1]``) of the TensorDict given to ``reset``, by default
        ``tote_size[2]``. The settings named by ``varies`` may be given there, too, see
        :data:`~pickplace.envs.episode.SETTINGS`; by default they are those of the full task. The bin has the episode's
        first items: up to ``bin_items``, as far as they have room, or only the first if nothing is feasible then.

    Episode end:
        ``terminated`` after a failed action, or if no action is feasible with any item in the bin (``stuck``);
        ``truncated`` when the item stream has ended. ``failure``, int64 ``[N, 1]``, is a :class:`Failure`.

    Args:
        items: an :class:`~pickplace.items.distributions.ItemDistribution`, or a list of ``(w, d, h)``; by default the
            paper's four kinds.
        num_envs: ``N``.
        seed: seed of the item stream.
        device: device of the tensors.
        stream: family of item streams, ``"train"``, ``"validation"`` or ``"test"``; these share no episodes.
        masks: the masks to emit, any of ``"action"``, ``"footprint"`` and ``"corner"``.
        observation: entries of the observation, :class:`~pickplace.rules.observation.Term` by key; the standard
            terms above are always among them.
        first_episode: number of the episode that slot 0 plays first; slot ``i`` plays ``first_episode + i``.
        episode_stride: step from the number of a slot's episode to that of its next one; by default ``num_envs``.
        varies: settings in which episodes may differ besides the height of the tote, names of
            :data:`~pickplace.envs.episode.SETTINGS`.
        **settings: sizes and options of the robot cell, see :class:`~pickplace.rules.cell.CellSpec`.

    Raises:
        ValueError: for impossible settings, among them a kind of item that has no feasible action on the empty tote
            for some position in the bin.
    """

    #: Arguments that a config may give. The others decide which episodes are played, and where.
    settings = (*CELL_SETTINGS, "num_envs", "observation")

    def __init__(
        self,
        items: ItemDistribution | list | tuple | None = None,
        num_envs: int = 128,
        seed: int = 0,
        device="cpu",
        stream: str = "train",
        masks: tuple[str, ...] = ("action",),
        observation: Mapping[str, Term] | None = None,
        first_episode: int = 0,
        episode_stride: int | None = None,
        varies: Collection[str] = (),
        **settings,
    ):
        unknown = [key for key in varies if key not in SETTINGS]
        expect(not unknown, "varies", varies, f"any of {', '.join(SETTINGS)}")
        cell = replace(cell_from_settings(settings), varies=tuple(varies))
        whole_number("num_envs", num_envs)
        check_seed(seed)
        one_of("stream", stream, STREAMS)
        known = isinstance(masks, (tuple, list)) and all(isinstance(name, str) and name in MASKS for name in masks)
        expect(known, "masks", masks, f"any of {', '.join(map(repr, MASKS))}")
        whole_number("first_episode", first_episode, 0, MAX_SEED)
        or_null(whole_number, "episode_stride", episode_stride, 1, MAX_SEED)
        items = Kinds(PAPER_KINDS) if items is None else items
        items = Kinds(items) if isinstance(items, (list, tuple)) else items
        kind = "a list of (w, d, h), or an ItemDistribution such as pickplace.items.distributions.Kinds"
        expect(isinstance(items, ItemDistribution), "items", items, kind)
        refuse_if(
            items.has_limits and not cell.handling,
            "env.handling=false: the items have greatest loads or turns of their own; expected env.handling=true.",
        )
        if cell.handling or cell.support.sees_boxes:
            cell = replace(cell, most_items=most_items(cell, items))
        self.items, self.cell, self.terms = items, cell, check_terms(observation, cell)
        check_samples(cell, items, stream)
        check_items(cell, items)
        check_tipping(cell, items)
        # Mixes and rotations with which every item fits the empty tote.
        self._checked_starts = {(0, SETTINGS["rotations"].full(cell) if "rotations" in varies else ALL_TURNS)}
        self.cell = replace(cell, longest_side=longest_side(cell, items))
        device = usable_device(device)
        words = f"num_envs={num_envs}"
        words += f" with room for {cell.room:,} items in a tote, which are recorded" if cell.record_bytes else ""
        check_bytes(words, num_envs * problem_bytes(self.cell, masks), device)
        super().__init__(device=device, batch_size=[num_envs])
        self.stream, self.masks = stream, tuple(masks)
        tallest = [*map(items.tallest, range(items.mixes))]
        self.limits = {key: RESET_ENTRIES[key].limits(cell, items) for key in ("tote_height", *varies)}
        self.first_episode, self.episode_stride = first_episode, episode_stride or num_envs
        highest = int(sizes_in_bin(cell, items)[:, 2].max())
        self.bounds = {key: term.bounds(self.cell, highest) for key, term in self.terms.items()}
        self.bounds["tote_height"] = self.bounds["tote_height"]._replace(low=min(tallest))
        specs: dict = {
            key: Bounded(low, high, (num_envs, *shape), dtype=dtype, device=device)
            for key, (low, high, shape, dtype) in self.bounds.items()
        }
        own = self.terms.keys() - standard_terms(self.cell).keys()
        self._own_terms = {key: (tuple(specs[key].shape), specs[key].dtype) for key in own}
        specs["occupancy"] = Bounded(0, 1, (num_envs, 1), dtype=torch.float32, device=device)
        specs["failure"] = Categorical(len(Failure), (num_envs, 1), dtype=torch.int64, device=device)
        sizes = {f"{name}_mask": MASKS[name].size(self.cell) for name in self.masks}
        specs |= {name: Binary(size, (num_envs, size), device, torch.bool) for name, size in sizes.items()}
        self.observation_spec = Composite(specs, shape=(num_envs,), device=device)
        # Declared as state too, so that reset() gets what a curriculum writes.
        given = {key: specs[key].clone() for key in self.limits}
        self.state_spec = Composite(given, shape=(num_envs,), device=device)
        self.action_spec = Categorical(self.cell.num_actions, (num_envs,), dtype=torch.int64, device=device)
        self.reward_spec = Unbounded((num_envs, 1), dtype=torch.float32, device=device)
        flags = {key: Categorical(2, (num_envs, 1), dtype=torch.bool, device=device) for key in DONE_KEYS}
        self.done_spec = Composite(flags, shape=(num_envs,), device=device)

        def zeros(*shape, dtype=torch.int64):
            return torch.zeros(num_envs, *shape, dtype=dtype, device=self.device)

        # All run-time state is in buffers, so that state_dict() contains it.
        buffers = {
            "surface": zeros(*cell.tote_size[:2], dtype=torch.int32) + EMPTY,
            "item": zeros(cell.bin_items, len(Item._fields)),
            "arrived": zeros(),  # number of the episode's items so far
            **({"coming": zeros(cell.preview, len(Item._fields))} if cell.preview else {}),
            "volume": zeros(),
            "steps": zeros(),
            "episode": zeros(),
            "item_seed": torch.tensor(0, device=self.device),
            "feasible": zeros(dtype=torch.bool),
            **(Pile.empty(num_envs, cell.tote_size, cell.room, self.device)._asdict() if cell.handling else {}),
            **({"boxes": zeros(cell.room, 6)} if cell.support.sees_boxes else {}),
            **{RESET_ENTRIES[key].field: zeros() + RESET_ENTRIES[key].full(cell) for key in self.limits},
            **{name: zeros(size, dtype=torch.bool) for name, size in sizes.items()},
        }
        for name, value in buffers.items():
            self.register_buffer(name, value)
        self.register_buffer("tallest", torch.tensor(tallest, device=self.device), persistent=False)  # of each mix
        self._make_masks = MaskMaker(self.cell, self.masks)
        self.set_seed(seed)

    @property
    def num_envs(self) -> int:
        """``N``, the number of problems that advance together."""
        return self.batch_size[0]

    # ------------------------------------------------------------------ EnvBase
    def reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        """Reset all problems, or those in ``_reset``; the others are returned unchanged.

        There are no other arguments: ``set_seed`` begins another item stream. TorchRL would fill the other rows with
        zeros if ``tensordict`` has only ``_reset``, and copy every mask cell by cell if it has more. Neither is
        needed: the environment still holds their observations.
        """
        if tensordict is None or "_reset" not in tensordict:
            return super().reset(tensordict, **kwargs)
        rows = tensordict["_reset"].reshape(self.num_envs, 1)
        kwargs.pop("select_reset_only", None)  # of ``EnvBase.reset``; the observation is complete in any case
        state = self._reset(tensordict, **kwargs)
        for key in (*DONE_KEYS, "failure"):
            if key in tensordict:
                state[key] = torch.where(rows, state[key], tensordict[key])
        return tensordict.exclude("_reset").update(state)

    def _set_seed(self, seed: int | None):
        """Restart the item stream: the next reset of slot ``i`` plays episode ``first_episode + i``."""
        self.item_seed.fill_(0 if seed is None else check_seed(seed))
        first = self.first_episode - self.episode_stride
        self.episode.copy_(torch.arange(first, first + self.num_envs, device=self.device))

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs) -> TensorDictBase:
        if kwargs:
            name, value = next(iter(kwargs.items()))
            raise TypeError(f"reset({name}={value!r}): expected a TensorDict only; set_seed(seed) begins a stream.")
        given = {} if tensordict is None else tensordict
        rows = given.get("_reset", torch.ones_like(self.feasible)).reshape(self.num_envs)
        self._read_settings(given, rows)
        self.episode.add_(rows * self.episode_stride)
        self.surface.masked_fill_(rows[:, None, None], EMPTY)
        self.item.masked_fill_(rows[:, None, None], 0)
        for count in (self.arrived, self.volume, self.steps):
            count.masked_fill_(rows, 0)
        for part in (*(self._pile or ()), *([] if self._boxes is None else [self._boxes])):
            part.masked_fill_(rows.view(-1, *[1] * (part.dim() - 1)), 0)
        self._refill(rows, self.state.items)
        self._update_masks(rows, empty=True)
        jammed = rows & ~self.feasible  # the first item alone always has a feasible action
        if self.cell.bin_items > self.cell.poses and any_of(jammed):
            self.item[:, self.cell.poses :] *= ~jammed[:, None, None]
            self.arrived.masked_fill_(jammed, 1)
            self._look_ahead()
            self._update_masks(jammed, empty=True)
        return self._observation().update({key: torch.zeros_like(rows)[:, None] for key in DONE_KEYS})

    def _read_settings(self, given, rows: Tensor) -> None:
        """Set the settings of the episodes that begin in ``rows``, bool ``[N]``, from the entries of a TensorDict."""
        found: dict[str, Tensor] = {}  # stored only after all of them are checked
        for key, (low, high) in self.limits.items():
            setting, values = RESET_ENTRIES[key], self.get_buffer(RESET_ENTRIES[key].field)
            wanted = values.masked_fill(rows, setting.full(self.cell))
            if key in given:
                wanted = torch.where(rows, setting.encode(given[key]), values)
            found[setting.field] = check_numbers(key, wanted, low, high, f"between {low} and {high}")
        height = found["tote_height"]
        mix = found.get("item_mix", torch.zeros_like(height))
        least = self.tallest[mix]
        require(
            height >= least,
            lambda low: (
                f"tote_height={int(height[low][0])}: expected at least {int(least[low][0])}, the height of the "
                "tallest item."
            ),
        )
        if self.cell.varies and not is_capturing():
            turns = found.get("turns", torch.full_like(height, ALL_TURNS))
            for pair in {*zip(mix[rows].tolist(), turns[rows].tolist(), strict=True)} - self._checked_starts:
                check_items(self.cell, self.items, *pair)
                self._checked_starts.add(pair)
        for name, values in found.items():
            self.get_buffer(name).copy_(values)

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        most, state = self.cell.num_actions - 1, self.state
        action = tensordict["action"].reshape(self.num_envs)
        step = apply(self.cell, state, check_numbers("action", action, 0, most, f"between 0 and {most} (N_a - 1)"))
        placed = step.failure == 0
        gained = torch.where(placed, step.item.volume, 0)
        self.surface.copy_(step.surface)
        for part, after in zip(self._pile or (), step.pile or (), strict=True):
            part.copy_(after)
        if step.boxes is not None:
            self.get_buffer("boxes").copy_(step.boxes)
        self.volume.add_(gained)
        self.steps.add_(placed)
        items = self._refill(placed, remove_item(self.cell, state.items, step.taken, placed))
        self._update_masks(placed)
        ended = placed & ~items.exists.any(1)  # the stream has no further item
        stuck = placed & ~self.feasible & ~ended
        failure = torch.where(stuck, int(Failure.STUCK), step.failure)
        result = {
            "reward": gained.float(),
            "failure": failure,
            "terminated": failure > 0,
            "truncated": ended,
            "done": (failure > 0) | ended,
        }
        return self._observation().update({key: value[:, None] for key, value in result.items()})

    # ------------------------------------------------------------------ state
    def _load_from_state_dict(self, *args, **kwargs):
        """Load into copies of the masks: the old tensors were handed out with an observation, see `_update_masks`."""
        for name in self.masks:
            setattr(self, f"{name}_mask", getattr(self, f"{name}_mask").clone())
        super()._load_from_state_dict(*args, **kwargs)

    @property
    def state(self) -> State:
        """The state of all problems."""
        items, coming = Item.from_table(self.item), Item.from_table(self.coming) if self.cell.preview else None
        return State(self.surface, self.tote_height, items, self._episode_settings, self._pile, coming, self._boxes)

    @property
    def _pile(self) -> Pile | None:
        return Pile(*map(self.get_buffer, Pile._fields)) if self.cell.handling else None

    @property
    def _boxes(self) -> Tensor | None:
        return self.get_buffer("boxes") if self.cell.support.sees_boxes else None

    @property
    def _episode_settings(self) -> EpisodeSettings:
        return EpisodeSettings(
            **{SETTINGS[key].field: self.get_buffer(SETTINGS[key].field) for key in self.cell.varies}
        )

    @property
    def exact_occupancy(self) -> Tensor:
        """The volume placed / the volume of the tote, float64 ``[N]``."""
        return self.volume.double() / self.cell.tote_volume(self.tote_height)

    def _refill(self, rows: Tensor, left: Item) -> Item:
        """Let items arrive in the bins in ``rows``, bool ``[N]``; ``left`` and the result are all items, ``[N, M]``."""
        rows = rows & may_arrive(self.cell, left, self._episode_settings)
        items, arrived = refill(self.cell, self.items, self.stream, *self._address, left, rows, self._episode_settings)
        self.item.copy_(items.table)
        self.arrived.copy_(arrived)
        self._look_ahead()
        return items

    def _look_ahead(self) -> None:
        """Update the items of the preview."""
        if self.cell.preview:
            coming = coming_items(self.cell, self.items, self.stream, *self._address, self._episode_settings)
            self.coming.copy_(coming.table)

    @property
    def _address(self) -> tuple[Tensor, Tensor, Tensor]:
        return self.item_seed.expand_as(self.episode), self.episode, self.arrived

    def _update_masks(self, rows: Tensor, empty: bool = False):
        """Recompute the masks of the problems in ``rows``, bool ``[N]``; the others' states did not change.

        Args:
            empty: the totes of these problems are empty.
        """
        if is_capturing():  # all rows, always, into the same tensors
            masks = self._make_masks.of(self.state)
            for name, old in [(name, self.get_buffer(f"{name}_mask")) for name in self.masks]:
                old.copy_(torch.where(rows[:, None], masks[name], old))
            self.feasible.copy_(torch.where(rows, _any(next(iter(masks.values()))), self.feasible))
            return
        numbers = rows.nonzero()[:, 0]
        if len(numbers) == 0:
            return
        index = slice(None) if len(numbers) == len(rows) else numbers
        make = self._make_masks.of_empty_totes if empty and self.device.type == "cpu" else self._make_masks.of
        masks = make(self.state.rows(index))
        self.feasible[index] = _any(next(iter(masks.values())))
        for name in self.masks:
            # A new tensor: the old one was handed out with an observation.
            old, new = getattr(self, f"{name}_mask"), masks[name]
            setattr(self, f"{name}_mask", new if len(numbers) == len(rows) else old.index_copy(0, numbers, new))

    def _observation(self) -> TensorDictBase:
        """Return the observation, with ``failure`` 0."""
        observation = observe(self.terms, self.cell, self.state)
        for key, (shape, dtype) in self._own_terms.items():
            if (found := observation[key]).shape != shape or found.dtype != dtype:
                got = f"observation.{key}: its value is {found.dtype} of shape {tuple(found.shape)}"
                raise ValueError(f"{got}, expected {dtype} of shape {shape}, as its bounds say.")
        observation["occupancy"] = self.exact_occupancy.float()[:, None]
        observation["failure"] = torch.zeros_like(self.tote_height)[:, None]
        for name in self.masks:
            mask = getattr(self, f"{name}_mask")  # never written to again, except in a capture, see `_update_masks`
            observation[f"{name}_mask"] = mask.clone() if is_capturing() else mask
        return TensorDict(observation, batch_size=self.batch_size, device=self.device)


def _any(mask: Tensor) -> Tensor:
    """Return the same as ``mask.any(1)``, which is far slower on a CPU."""
    return mask.view(torch.uint8).amax(1) > 0
