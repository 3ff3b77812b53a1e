import numpy as np
import pytest

from service.downstream.learner import make_learner, set_progress
from service.downstream.methods import METHODS
from service.downstream.settings import SACConfig, make_trial
from service.downstream.worker import make_worlds
from tests.downstream.trials import SMALL, small_trial


def test_every_setting_reaches_the_learner(champion):
    settings = {
        "num_worlds": 3,
        "gradient_steps": 5,
        "batch_size": 24,
        "learning_rate": 2e-3,
        "gamma": 0.83,
        "tau": 0.17,
        "initial_entropy_coefficient": 0.37,
        "hidden_sizes": (12, 7),
        "learning_starts": 160,
    }
    assert all(settings[name] != field.default for name, field in SACConfig.model_fields.items())
    trial = make_trial(task="push", method="ours", num_env_steps=500, sac=settings)
    env = make_worlds(trial, METHODS["ours"], champion, 1)
    learner = make_learner(trial, METHODS["ours"], env)
    assert learner.n_envs == 3
    assert learner.gradient_steps == 5
    assert learner.batch_size == 24
    assert learner.lr_schedule(1.0) == learner.lr_schedule(0.0) == 2e-3
    assert learner.gamma == 0.83
    assert learner.tau == 0.17
    assert learner.log_ent_coef.exp().item() == pytest.approx(0.37)
    for network in (learner.actor.latent_pi, learner.critic.qf0):
        assert [layer.out_features for layer in network if hasattr(layer, "out_features")][:2] == [12, 7]
    assert learner.learning_starts == 160
    assert learner.replay_buffer.buffer_size * 3 == 501  # all 500, in whole steps of 3 worlds
    env.close()


def test_the_critics_learn_from_discounted_values_and_entropy_by_hand(champion):
    """One update: the critics' loss is that of r + gamma (min Q(s', a') - alpha log p(a'|s')), no episode ending."""
    import torch

    trial = small_trial("ours")
    env = make_worlds(trial, METHODS["ours"], champion, 1)
    learner = make_learner(trial, METHODS["ours"], env)
    learner.learn(SMALL["learning_starts"])
    np_state, torch_state = np.random.get_state(), torch.get_rng_state()
    batch = learner.replay_buffer.sample(SMALL["batch_size"])
    with torch.no_grad():
        alpha = learner.log_ent_coef.exp()
        learner.actor.action_log_prob(batch.observations)  # the actor's own loss draws first
        action, log_prob = learner.actor.action_log_prob(batch.next_observations)
        following = torch.minimum(*learner.critic_target(batch.next_observations, action))[:, 0]
        target = batch.rewards[:, 0] + 0.95 * (following - alpha * log_prob)
        values = learner.critic(batch.observations, batch.actions)
        expected = 0.5 * sum(((value[:, 0] - target) ** 2).mean() for value in values)
    np.random.set_state(np_state)
    torch.set_rng_state(torch_state)
    learner.train(1, SMALL["batch_size"])
    assert learner.logger.name_to_value["train/critic_loss"] == pytest.approx(expected.item(), rel=1e-5)
    assert alpha == pytest.approx(0.1)
    env.close()


def test_relabelled_goals_are_where_the_object_came_to_later_in_the_episode(champion):
    trial = small_trial("ours-her")
    env = make_worlds(trial, METHODS["ours-her"], champion, 1)
    learner = make_learner(trial, METHODS["ours-her"], env)
    learner.learn(SMALL["learning_starts"])  # an episode of 50 steps in each of four worlds
    buffer = learner.replay_buffer
    places = buffer.next_observations["achieved_goal"]
    places[:50] = np.stack([*np.mgrid[:50, :4], np.zeros((50, 4))], axis=-1)  # (step, world, 0): no two are the same
    buffer.her_ratio = 1.0
    np.random.seed(0)
    sample = buffer.sample(400)
    step, world, _ = sample.next_observations["achieved_goal"].numpy().T
    goal_step, goal_world, _ = sample.observations["desired_goal"].numpy().T
    np.testing.assert_array_equal(goal_world, world)
    assert (goal_step >= step).all()
    early = step < 10
    assert early.sum() > 40
    # any later step with equal chance: of 40 to 50 steps about half are before the 30th, not all are the last
    assert 0.25 < (goal_step[early] < 30).mean() < 0.75
    env.close()


@pytest.mark.parametrize(
    ("method", "shares"), [("ours-her", (0.8, 0.4, 0.0)), ("scratch-monolithic-her", (0.8, 0.8, 0.8)), ("ours", None)]
)
def test_the_share_of_relabelled_goals(champion, method, shares):
    trial = small_trial(method)
    env = make_worlds(trial, METHODS[method], champion, 1)
    learner = make_learner(trial, METHODS[method], env)
    learner.learn(SMALL["learning_starts"])
    buffer, relabelled = learner.replay_buffer, []
    if shares is not None:
        assert buffer.her_ratio == 0.8  # SB3's own, of k = 4
        compute = buffer.env.env_method
        buffer.env.env_method = lambda *given, **named: relabelled.append(len(given[1])) or compute(*given, **named)
    for progress, share in zip((0.0, 0.5, 1.0), shares or (None,) * 3, strict=True):
        set_progress(learner, METHODS[method], progress)
        relabelled.clear()
        learner.train(1, 100)
        assert relabelled == ([] if share is None else [100 * share])
    env.close()
