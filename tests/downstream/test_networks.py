import math

import numpy as np
import torch

from service.downstream.learner import make_learner
from service.downstream.methods import METHODS
from service.downstream.networks import GoalFeatures
from service.downstream.worker import make_worlds
from service.envs.observations import BOB
from service.policies.composition import compose
from service.policies.networks import export_parameters
from service.policies.numpy_policy import NumpyMCPPolicy
from tests.downstream.trials import small_trial


def learner_of(method, champion):
    trial = small_trial(method)
    env = make_worlds(trial, METHODS[method], champion, 1)
    learner = make_learner(trial, METHODS[method], env)
    return learner, env


def observations(env, num_steps=3):
    env.seed(0)
    seen = env.reset()
    for _ in range(num_steps):
        seen = env.step(np.stack([env.action_space.sample() for _ in range(env.num_envs)]))[0]
    return {key: torch.from_numpy(value) for key, value in seen.items()}


def test_the_mcp_actor_is_the_composition_squashed(champion):
    """Against the torch-free evaluator of the same parameters, and the tanh's Jacobian by hand."""
    learner, env = learner_of("scratch-mcp", champion)
    seen, actor = observations(env), learner.actor
    evaluator = NumpyMCPPolicy(export_parameters(actor.mcp))
    rows = torch.cat((seen["observation"], seen["desired_goal"]), 1).numpy()
    weights, (means, variances) = evaluator.gate(rows), evaluator.primitives(rows[:, :11])
    assert weights.shape == (4, 4)
    mean, variance = compose(weights, means, variances)
    with torch.no_grad():
        found_mean, found_log_std, _ = actor.get_action_dist_params(seen)
        np.testing.assert_allclose(found_mean, mean, rtol=0, atol=1e-5)
        np.testing.assert_allclose(found_log_std.exp(), np.sqrt(variance), rtol=1e-5)
        np.testing.assert_allclose(actor(seen, deterministic=True), np.tanh(mean), rtol=0, atol=1e-5)
        torch.manual_seed(0)
        actions, log_prob = actor.action_log_prob(seen)
    before = np.arctanh(actions.numpy().astype(np.float64))
    gaussian = -0.5 * (before - mean) ** 2 / variance - 0.5 * np.log(2 * math.pi * variance)
    jacobian = np.log(1.0 - actions.numpy().astype(np.float64) ** 2 + 1e-6)
    np.testing.assert_allclose(log_prob, (gaussian - jacobian).sum(1), rtol=0, atol=2e-3)
    env.close()


def test_everything_the_mcp_actor_has_is_learned(champion):
    learner, env = learner_of("scratch-mcp-her", champion)
    before = {name: value.clone() for name, value in learner.actor.named_parameters()}
    learner.learn(400)
    same = [name for name, value in learner.actor.named_parameters() if torch.equal(value, before[name])]
    assert same == []
    assert all(name.startswith("mcp.") for name in before)
    env.close()


def test_features_by_hand():
    from service.envs.gym.tabletop import goal_space

    observation = torch.zeros(1, 11)
    observation[0, 5:8] = torch.tensor([0.1, 0.2, 0.3])
    goal = torch.tensor([[0.15, 0.1, 0.3]])
    moved = torch.tensor([[0.02, 0.0, -0.01, 0.001, 0.0, 0.0, 0.2, -0.04, 0.0, 0.0, 0.0]])  # fingers are left out
    seen = {"observation": observation, "previous": observation - moved, "desired_goal": goal, "achieved_goal": goal}
    found = GoalFeatures(goal_space())(seen)
    assert found.shape == (1, 23)
    rows = np.concatenate((observation, goal), 1)
    np.testing.assert_allclose(
        found[:, :14], np.clip((rows - BOB.normalisation.offset) / BOB.normalisation.scale, -5, 5)
    )
    np.testing.assert_allclose(found[0, 14:17], [0.5, -1.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(found[0, 17:], [1.0, 0.0, -0.5, 0.0, 5.0, -2.0], atol=1e-5)  # of 2 cm, at most five


def test_a_learned_policy_acts_as_in_its_worlds(champion):
    """Evaluation goes another way than learning, from Bob's input to actions; both compose alike."""
    from service.downstream.learner import LearnedPolicy

    for method in ("ours", "scratch-monolithic"):
        learner, env = learner_of(method, champion)
        player, handed = LearnedPolicy(learner, METHODS[method], champion), []
        worlds = env.env if method == "scratch-monolithic" else env.env.env
        step = worlds.step
        worlds.step = lambda actions, handed=handed, step=step: handed.append(actions) or step(actions)
        seen = env.reset()
        for _ in range(3):
            weights, _ = learner.predict(seen, deterministic=True)
            rows = np.concatenate((seen["observation"], seen["desired_goal"]), 1)
            seen, *_ = env.step(weights)
            np.testing.assert_allclose(player.act_deterministic(rows), handed[-1], rtol=0, atol=1e-6)
        env.close()
