"""The dictionaries `info` and `infos`.

A reset's info has, if receipts were asked for:

- `parameters`: what was drawn or given, by name;
- `receipt`: which episode this is (`environment_index`, `trial_index`, `episode_index`), `applied`, the values read
  back from the physics, by name, and `model_hash`;
- `context_id`: the trial's index, which counts the draws of parameters.

The info of an episode's last step has these too, `is_success` and `diverged`, and `achieved` unless there is nothing:
the value of the quantity that the rule of success compares. Every step's has `reward_terms`, if they were asked for.
Nothing in them depends on the clock.

Of a batch, each key holds an array [N], and the key with an underscore before it a mask of the environments that have
it, as `VectorEnv._add_info` of Gymnasium makes them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from ._proto import perturb_pb2 as pb


class Names:
    """What the numbers of receipts and reward terms are called."""

    def __init__(self, environment: pb.Environment) -> None:
        self.parameters = [parameter.name for parameter in environment.parameters]
        self.applied = [quantity.name for quantity in environment.applied]
        self.reward_terms = [term.name for term in environment.reward_terms]

    def started(self, start: pb.EpisodeStart) -> dict[str, Any]:
        """Info of one environment's new episode, which came with a receipt."""
        return self._receipt(start)

    def ended(self, end: pb.EpisodeEnd) -> dict[str, Any]:
        """Info of one environment's ended episode."""
        info = {"is_success": end.success, "diverged": end.diverged}
        achieved = {"achieved": end.achieved} if end.HasField("achieved") else {}
        return {**info, **achieved, **(self._receipt(end) if end.HasField("receipt") else {})}

    def terms(self, terms: NDArray[np.float32]) -> dict[str, Any]:
        """Info of one environment's reward terms [terms]."""
        return {"reward_terms": dict(zip(self.reward_terms, terms.tolist(), strict=True))}

    def _receipt(self, message: pb.EpisodeStart | pb.EpisodeEnd) -> dict[str, Any]:
        episode, receipt = message.episode, message.receipt
        return {
            "context_id": episode.trial_index,
            "parameters": dict(zip(self.parameters, receipt.requested, strict=True)),
            "receipt": {
                "environment_index": episode.environment_index,
                "trial_index": episode.trial_index,
                "episode_index": episode.episode_index,
                "applied": dict(zip(self.applied, receipt.applied, strict=True)),
                "model_hash": receipt.model_hash,
            },
        }


class BatchInfos:
    """Collects the infos of N environments."""

    def __init__(self, names: Names, num_envs: int) -> None:
        self._names = names
        self._num_envs = num_envs
        self.infos: dict[str, Any] = {}

    def episodes(self, ends: Sequence[pb.EpisodeEnd], starts: Sequence[pb.EpisodeStart]) -> None:
        """Add episodes that ended, and others that began, which come only with receipts. Called once."""
        if ends:
            slots = [end.slot for end in ends]
            self._put(self.infos, "is_success", slots, np.array([end.success for end in ends]))
            self._put(self.infos, "diverged", slots, np.array([end.diverged for end in ends]))
        reached = [end for end in ends if end.HasField("achieved")]
        if reached:
            slots = [end.slot for end in reached]
            self._put(self.infos, "achieved", slots, np.array([end.achieved for end in reached]))
        begun_or_ended: list[pb.EpisodeStart | pb.EpisodeEnd] = [*starts]
        if ends and ends[0].HasField("receipt"):
            begun_or_ended += ends
        if begun_or_ended:
            self._receipts(begun_or_ended, [message.slot for message in begun_or_ended])

    def terms(self, terms: NDArray[np.float32], slots: NDArray[np.intp]) -> None:
        """Add the reward terms [N, terms] of the environments that took a step."""
        if slots.size > 0:
            values = terms[slots].astype(np.float64)
            self._put_named(self.infos, "reward_terms", slots, self._names.reward_terms, values)

    def final_observations(self, observations: NDArray[np.float32], slots: Sequence[int]) -> None:
        """Add the last observations [K, O] of ended episodes."""
        values = np.full(len(slots), None, dtype=object)
        values[:] = list(observations)
        self._put(self.infos, "final_obs", slots, values)

    def final_infos(self, ended: BatchInfos, slots: Sequence[int]) -> None:
        """Add the infos of the steps that ended episodes."""
        self.infos["final_info"] = ended.infos
        self._mark(self.infos, "final_info", slots)

    def _receipts(self, messages: Sequence[pb.EpisodeStart | pb.EpisodeEnd], slots: Sequence[int]) -> None:
        names = self._names
        episodes = [message.episode for message in messages]
        receipts = [message.receipt for message in messages]
        trials = np.array([episode.trial_index for episode in episodes])
        # A slice is a list, which NumPy reads thirty times as fast as protobuf's own container.
        requested = np.array([receipt.requested[:] for receipt in receipts])
        applied = np.array([receipt.applied[:] for receipt in receipts])
        self._put(self.infos, "context_id", slots, trials)
        self._put_named(self.infos, "parameters", slots, names.parameters, requested)
        receipt = self._nested(self.infos, "receipt", slots)
        self._put(receipt, "environment_index", slots, np.array([episode.environment_index for episode in episodes]))
        self._put(receipt, "trial_index", slots, trials)
        self._put(receipt, "episode_index", slots, np.array([episode.episode_index for episode in episodes]))
        self._put_named(receipt, "applied", slots, names.applied, applied)
        hashes = np.array([receipt.model_hash for receipt in receipts], dtype=object)
        self._put(receipt, "model_hash", slots, hashes)

    def _put_named(
        self,
        infos: dict[str, Any],
        key: str,
        slots: Sequence[int] | NDArray[np.intp],
        names: Sequence[str],
        values: NDArray[np.float64],
    ) -> None:
        nested = self._nested(infos, key, slots)
        mask = infos[f"_{key}"]
        rows = np.zeros((len(names), self._num_envs))
        rows[:, slots] = values.T
        for name, row in zip(names, rows, strict=True):
            nested[name], nested[f"_{name}"] = row, mask.copy()

    def _nested(self, infos: dict[str, Any], key: str, slots: Sequence[int] | NDArray[np.intp]) -> dict[str, Any]:
        nested: dict[str, Any] = infos.setdefault(key, {})
        self._mark(infos, key, slots)
        return nested

    def _put(
        self, infos: dict[str, Any], key: str, slots: Sequence[int] | NDArray[np.intp], values: NDArray[Any]
    ) -> None:
        array = infos.get(key)
        if array is None:
            empty = None if values.dtype == object else 0
            array = infos[key] = np.full(self._num_envs, empty, dtype=values.dtype)
        array[slots] = values
        self._mark(infos, key, slots)

    def _mark(self, infos: dict[str, Any], key: str, slots: Sequence[int] | NDArray[np.intp]) -> None:
        mask = infos.get(f"_{key}")
        if mask is None:
            mask = infos[f"_{key}"] = np.zeros(self._num_envs, dtype=np.bool_)
        mask[slots] = True
