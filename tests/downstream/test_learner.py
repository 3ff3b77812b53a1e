import pytest

from service.downstream.learner import make_learner, set_progress
from service.downstream.methods import METHODS
from service.downstream.worker import make_worlds
from tests.downstream.cells import SMALL, small_cell


@pytest.mark.parametrize(
    ("method", "shares"), [("ours-her", (0.8, 0.4, 0.0)), ("scratch-monolithic-her", (0.8, 0.8, 0.8)), ("ours", None)]
)
def test_the_share_of_relabelled_goals(champion, method, shares):
    cell = small_cell(method)
    env = make_worlds(cell, METHODS[method], champion, 1)
    learner = make_learner(cell, METHODS[method], env)
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
