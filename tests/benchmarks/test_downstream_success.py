import numpy as np
import pytest

import service
from benchmarks import downstream_success
from service.actors.evaluation import evaluate
from service.downstream.methods import METHODS
from service.downstream.worker import FINAL_SEED
from service.envs.tasks import SUCCESS_DISTANCE_M, find_task
from tests.downstream.trials import small_trial


@pytest.fixture(scope="module")
def trained():
    return service.load_primitives("panda-cube@champion", registry="no registry here")


def test_learns_and_is_evaluated_as_the_cells_are(trained, monkeypatch):
    learners = []
    make = downstream_success.default_learner
    monkeypatch.setattr(
        downstream_success, "default_learner", lambda *given: learners.append(make(*given)) or learners[-1]
    )
    cell = small_trial(num_env_steps=201, task="larger")
    result = downstream_success.learn(cell, trained, downstream_success.Settings(every=150, threads=1))
    (learner,) = learners
    assert [point["env_steps"] for point in result["curve"]] == [150, 201]
    assert learner._n_updates == 201 - 100  # one after every step but the first hundred
    task = find_task("larger")
    again = evaluate(
        downstream_success.DefaultPolicy(learner, METHODS["ours"], trained),
        task.world_from(trained.config.world),
        task.goals,
        num_episodes=6,
        num_steps=50,
        success_distance_m=SUCCESS_DISTANCE_M,
        seed=FINAL_SEED,
    )
    assert result["evaluation"] == again.as_dict()
    assert result["settings"]["primitives"]["name"] == trained.manifest.reference


def test_acts_as_the_environment_that_it_learned_in(trained):
    cell = small_trial(task="wall")
    learner = downstream_success.default_learner(cell, trained)
    env = learner.get_env()
    seen = env.reset()
    weights, _ = learner.predict(seen, deterministic=True)
    before = np.concatenate([seen["observation"], seen["desired_goal"]], axis=1).astype(np.float32)
    acted = []
    inner = env.envs[0].unwrapped
    step = inner.step
    inner.step = lambda action: acted.append(np.array(action)) or step(action)
    env.step(weights)
    player = downstream_success.DefaultPolicy(learner, METHODS["ours"], trained)
    np.testing.assert_allclose(player.act_deterministic(before)[0], acted[0], atol=1e-6)
