"""Data sets: what Minari reads back is what was played, by the environment's own rules."""

import json

import minari
import numpy as np
import pytest

from service.config import WorldConfig
from service.config.self_play import SelfPlayConfig
from service.envs.gym.tabletop import TabletopEnv
from service.media.dataset import Played, played_episodes, played_turns, write_dataset
from service.media.recording import play_rounds, record_episodes
from tests.cli.typed import assert_refused, tandem
from tests.media.test_recording import NOTHING, PUSH, Constant

CONFIG = SelfPlayConfig(
    world=WorldConfig(physics_step_s=0.005, num_substeps=8),
    game={"alice_steps": 12, "bob_steps": 12, "blocked_gripper_fraction": 0.5},
)


@pytest.fixture(autouse=True)
def place(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "sets"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "sets"


def test_bobs_episodes_are_those_that_the_environment_plays(place):
    recorded = record_episodes(
        Constant(PUSH), CONFIG.world, "table", num_episodes=3, num_steps=5, success_distance_m=0.05, seed=0
    )
    path = write_dataset("some/bob-v2", played_episodes(recorded), CONFIG, "here", success_distance_m=0.05)
    assert path == place / "some" / "bob-v2"
    read = minari.load_dataset("some/bob-v2")
    assert (read.total_episodes, read.total_steps) == (3, 15)
    assert json.loads(read.storage.metadata["description"])["world"] == CONFIG.world.model_dump(mode="json")
    env = TabletopEnv(CONFIG.world)
    env.reset(seed=0)
    for episode in read.iterate_episodes():
        state = env.state()
        state.worlds[:], state.goal[:] = recorded.states[0, episode.id], recorded.goal[episode.id]
        seen = [env.restore(state)]
        for step, action in enumerate(episode.actions):
            observation, reward, _, _, info = env.step(action)
            assert (episode.rewards[step], episode.infos["is_success"][step + 1]) == (reward, info["is_success"])
            seen.append(observation)
        for name, values in episode.observations.items():
            np.testing.assert_array_equal(values, [each[name] for each in seen])
        assert episode.truncations.tolist() == [False] * 4 + [True]
        assert not episode.terminations.any()
        assert not episode.infos["is_alice"].any()
    env.close()


def test_rounds_are_turns_of_both():
    rounds = play_rounds(CONFIG, Constant(PUSH), Constant(NOTHING), num_rounds=66, seed=0)
    assert len(rounds) == 66
    write_dataset("rounds", played_turns(rounds), CONFIG, "here", success_distance_m=0.05)
    turns = list(minari.load_dataset("rounds-v0").iterate_episodes())
    alices = [each for each in turns if each.infos["is_alice"].all()]
    bobs = [each for each in turns if not each.infos["is_alice"].any()]
    assert len(alices) == 66
    assert len(bobs) == sum(len(each.bob_actions) > 0 for each in rounds) > 0
    for turn, played in zip(alices, rounds, strict=True):
        np.testing.assert_allclose(turn.observations["achieved_goal"][-1], played.goal, rtol=0, atol=1e-6)
        assert turn.rewards[-1] == 1.0
        np.testing.assert_array_equal(turn.actions, np.tile(np.float32(PUSH), (12, 1)))


def test_rounds_without_alice_are_turns_of_bob():
    alone = CONFIG.model_dump(mode="json") | {"generator": {"goal_source": "uniform", "replay_invalid": True}}
    config = SelfPlayConfig.model_validate(alone | {"game": alone["game"] | {"alice_plays": False}})
    rounds = play_rounds(config, Constant(NOTHING), Constant(PUSH), num_rounds=4, seed=0)
    write_dataset("alone", played_turns(rounds), config, "here", success_distance_m=0.05)
    turns = list(minari.load_dataset("alone-v0").iterate_episodes())
    assert len(turns) == 4
    assert not any(each.infos["is_alice"].any() for each in turns)
    assert all(len(each.observations["achieved_goal"]) == len(each.actions) + 1 for each in turns)


def test_the_command_writes_the_champions_episodes_and_refuses_what_is_there(place):
    arguments = ("dataset", "panda-cube@champion", "--episodes", 4, "--goals", "0,0,0.2", "--out", "champion")
    done = tandem(*arguments)
    assert done.exit_code == 0, done.output
    assert done.stdout == f"4 episodes, 200 steps: champion-v0 in {place / 'champion-v0'}\n"
    read = minari.load_dataset("champion-v0")
    last = [episode.infos["is_success"][-1] for episode in read.iterate_episodes()]
    assert sum(last) >= 3  # it reaches 99 % of goals in the air
    assert_refused(tandem(*arguments), "the data set champion-v0 is there already")


@pytest.mark.parametrize("name", ["../up", "panda.cube", "g/cube"])
def test_a_name_that_is_none_is_refused(place, name):
    assert_refused(tandem("dataset", "panda-cube@champion", "--out", name), f"--out '{name}': write NAME")


def test_half_a_data_set_is_taken_away(place):
    wrong = Played(np.zeros((3, 5)), np.zeros((2, 4), dtype=np.float32), np.zeros(3))
    with pytest.raises(ValueError, match="shape"):
        write_dataset("half", [wrong], CONFIG, "here", success_distance_m=0.05)
    assert not (place / "half-v0").exists()
