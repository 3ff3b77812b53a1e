"""Stable-Baselines3's SAC on many worlds: made from settings, saved whole, and restored to continue exactly."""

from __future__ import annotations

import json
from typing import Any, cast

import numpy as np
import torch
from gymnasium.spaces import Dict
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.sac.policies import MultiInputPolicy

from service.downstream.methods import Method
from service.downstream.networks import GoalFeatures, MCPSACPolicy
from service.downstream.settings import TrialConfig
from service.downstream.vec_env import PREVIOUS, WorldsVecEnv
from service.envs.observations import BOB, POSITIONS
from service.primitives.loading import TrainedBob
from service.types import FloatArray

_ROWS = ("actions", "rewards", "dones", "timeouts", "ep_start", "ep_length")
_COUNTERS = ("num_timesteps", "_n_updates", "_episode_num")


def make_learner(trial: TrialConfig, method: Method, env: WorldsVecEnv) -> SAC:
    """Make a new learner; draws from the global random numbers of torch and NumPy, which its seed restarts."""
    sac = trial.sac
    learner = SAC(
        MCPSACPolicy if method.mcp_actor else MultiInputPolicy,
        env,
        learning_rate=sac.learning_rate,
        buffer_size=-(-trial.num_env_steps // sac.num_worlds) * sac.num_worlds,  # everything is kept
        learning_starts=sac.learning_starts,
        batch_size=sac.batch_size,
        tau=sac.tau,
        gamma=sac.gamma,
        train_freq=1,
        gradient_steps=sac.gradient_steps,
        ent_coef=f"auto_{sac.initial_entropy_coefficient}",
        replay_buffer_class=HerReplayBuffer if method.her_ratio else DictReplayBuffer,
        replay_buffer_kwargs={"goal_selection_strategy": "future"} if method.her_ratio else None,
        policy_kwargs={
            "features_extractor_class": GoalFeatures,
            "net_arch": list(sac.hidden_sizes),
            "optimizer_kwargs": {"fused": True},  # a tenth of an update's time
        },
        seed=_spread_seed(trial.seed),
        device="cpu",
    )
    learner.set_logger(Logger(folder=None, output_formats=[]))  # else every ``learn`` makes a directory in /tmp
    return learner


def set_progress(learner: SAC, method: Method, progress: float) -> None:
    """Set the share of relabelled goals for a progress from 0, when learning begins, to 1, when it ends."""
    if method.her_ratio is None:
        return
    first, last = method.her_ratio
    assert isinstance(learner.replay_buffer, HerReplayBuffer)
    learner.replay_buffer.her_ratio = first + (last - first) * progress


def _spread_seed(seed: int) -> int:
    """A seed far from those of other trials: world i gets it plus i, so neighbours would share nearly all episodes."""
    return int(np.random.SeedSequence(seed).generate_state(1)[0]) >> 1


class LearnedPolicy:
    """The policy of a learner, as evaluations and videos take it: Bob's input to actions, without noise.

    Plays N episodes from their start; others need another one, since it keeps the positions of the step before.
    """

    def __init__(self, learner: SAC, method: Method, trained: TrainedBob) -> None:
        self._learner, self._method, self._trained = learner, method, trained
        self._previous: FloatArray | None = None

    def act_deterministic(self, observation: FloatArray) -> FloatArray:
        """(N, 14) Bob's input to actions (N, 4)."""
        positions = observation[:, : POSITIONS.size]
        previous, self._previous = self._previous, positions.copy()
        seen: dict[str, Any] = {
            "observation": positions,
            "achieved_goal": observation[:, BOB["object"]],
            "desired_goal": observation[:, BOB["goal"]],
            PREVIOUS: positions if previous is None else previous,
        }
        actions, _ = self._learner.predict(
            {name: seen[name] for name in cast(Dict, self._learner.observation_space)}, deterministic=True
        )
        return self._method.decode(self._trained, positions, actions)


def save_learner(learner: SAC, env: WorldsVecEnv) -> dict[str, Any]:
    """Everything the learner continues from, as tensors and plain values: its random numbers and worlds, too."""
    entropy, worlds = learner.log_ent_coef, env.state()
    assert entropy is not None
    random = json.dumps(worlds.pop("random"))
    kind, keys, *rest = cast("tuple[Any, ...]", np.random.get_state())  # Stable-Baselines3 draws its batches from it
    return {
        "parameters": learner.get_parameters(),
        "log_ent_coef": entropy.detach().clone(),
        "counters": {name: getattr(learner, name) for name in _COUNTERS},
        "replay": _save_replay(learner.replay_buffer),
        "worlds": {"arrays": {name: torch.from_numpy(rows) for name, rows in worlds.items()}, "random": random},
        "torch_random": torch.get_rng_state(),
        "numpy_random": [kind, torch.from_numpy(keys.copy()), *rest],
        "action_random": json.dumps(learner.action_space.np_random.bit_generator.state),
    }


def restore_learner(learner: SAC, env: WorldsVecEnv, saved: dict[str, Any]) -> None:
    """Go back to what ``save_learner`` gave, in a new learner and worlds of the same settings."""
    entropy = learner.log_ent_coef
    assert entropy is not None
    learner.set_parameters(saved["parameters"], exact_match=True, device="cpu")
    with torch.no_grad():
        entropy.copy_(saved["log_ent_coef"])  # in place: its optimiser holds it
    for name, value in saved["counters"].items():
        setattr(learner, name, value)
    _restore_replay(learner.replay_buffer, saved["replay"])
    worlds = {name: rows.numpy() for name, rows in saved["worlds"]["arrays"].items()}
    learner._last_obs = env.restore({**worlds, "random": tuple(json.loads(saved["worlds"]["random"]))})
    learner._last_episode_starts = np.zeros(env.num_envs, dtype=bool)
    torch.set_rng_state(saved["torch_random"])
    kind, keys, *rest = saved["numpy_random"]
    np.random.set_state((kind, keys.numpy(), *rest))
    learner.action_space.np_random.bit_generator.state = json.loads(saved["action_random"])


def _save_replay(buffer: Any) -> dict[str, Any]:
    """The rows of a replay buffer that are in use."""
    used = buffer.buffer_size if buffer.full else buffer.pos
    rows = {name: torch.from_numpy(getattr(buffer, name)[:used]) for name in _ROWS if hasattr(buffer, name)}
    for group in ("observations", "next_observations"):
        rows |= {f"{group}/{key}": torch.from_numpy(each[:used]) for key, each in getattr(buffer, group).items()}
    starts = getattr(buffer, "_current_ep_start", None)
    return {"rows": rows, "pos": buffer.pos, "full": buffer.full, "starts": None if starts is None else starts.tolist()}


def _restore_replay(buffer: Any, saved: dict[str, Any]) -> None:
    for name, rows in saved["rows"].items():
        group, _, key = name.partition("/")
        target = getattr(buffer, group)
        (target[key] if key else target)[: len(rows)] = rows.numpy()
    buffer.pos, buffer.full = saved["pos"], saved["full"]
    if saved["starts"] is not None:
        buffer._current_ep_start[:] = saved["starts"]
