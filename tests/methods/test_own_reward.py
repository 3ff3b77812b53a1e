"""An intrinsic reward from a user's file: trained, killed, resumed, published, and loaded without its code."""

import numpy as np
import pytest

from service.base.errors import ConfigError, TandemError
from service.config import load_config
from service.registry.loading import load
from service.registry.publishing import publish
from service.registry.registry import Registry
from service.runs.resuming import resumed_config
from service.runs.train import train
from service.store.run_directory import RunDirectory
from tests.runs.runs import KilledError, assert_one_line, assert_same_run

pytestmark = pytest.mark.usefixtures("default_signals", "no_artifacts")
CODE = """
from service.methods.intrinsic_reward import IntrinsicReward

class Upwards(IntrinsicReward):
    prior = "sphere"
    zero_shot = "none"
    pays_features = True

    def loss(self, before, after, skill):
        return -(self.paid(before, after, skill) * skill).sum(dim=1).mean() + self.network(after).square().mean()

    def paid(self, before, after, skill):
        return self.network(after) - self.network(before)
"""
NESTED = """
    def make_network(self):
        from torch import nn
        return nn.Sequential(nn.Linear(3, 8), nn.Tanh(), nn.Linear(8, self.config.size))

    def loss"""
FORGETS = """
    scale = 1.0

    def learn(self, before, after, skill):
        self.scale += 1.0
        return self.scale * super().learn(before, after, skill)

    def loss"""
SMALL = (
    "method=skills", "skills.method=upwards.py:Upwards", "skills.size=3", "skills.episode_steps=5",
    "skills.hidden_sizes=[8]", "skills.batch_size=8", "skills.sac.num_worlds=4", "skills.sac.gradient_steps=1",
    "skills.sac.batch_size=16", "skills.sac.learning_starts=20", "skills.sac.hidden_sizes=[8]",
    "run.total_env_steps=120", "run.checkpoint_interval=2", "run.evaluation_interval=0", "run.num_threads=1", "name=up",
)  # fmt: skip


@pytest.fixture
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "upwards.py").write_text(CODE)
    return tmp_path / "upwards.py"


def test_it_goes_the_way_of_ours(file, tmp_path):
    def kill(metrics):
        if metrics["iteration"] == 5:
            raise KilledError

    registry = tmp_path / "registry"
    config = load_config(None, SMALL).begin(registry, None)
    assert (config.skills.prior, config.skills.zero_shot, config.code) == ("sphere", "none", {"upwards.py": CODE})
    train(config, RunDirectory(tmp_path / "whole"), registry, publish=False, on_iteration=lambda _: None)
    with pytest.raises(KilledError):
        train(config, RunDirectory(tmp_path / "cut"), registry, publish=False, on_iteration=kill)
    file.unlink()
    directory = RunDirectory(tmp_path / "cut")
    train(resumed_config(directory, []), directory, registry, resume=True, publish=False, on_iteration=lambda _: None)
    assert_same_run(tmp_path / "whole", tmp_path / "cut")
    found = load(str(tmp_path / "whole"), registry)
    version = publish(Registry(registry), config, found.parameters, {})
    skills = load(str(version), registry).skills
    drawn = skills.draw(50, np.random.default_rng(0))
    np.testing.assert_allclose(np.linalg.norm(drawn, axis=1), 1.0, rtol=1e-5)
    with pytest.raises(TandemError, match=r"skills of upwards.py:Upwards lead to no goal"):
        skills.towards(np.zeros((1, 11), np.float32), np.zeros((1, 3), np.float32))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("dim=1).mean()", "dim=7).mean()", "upwards.py:10: IndexError: "),
        ("pays_features = True", "pays_features = False", "Upwards.paid gave shape [16, 3]; give [16], or set pays"),
        ("- self.network(before)", ".mean()", "Upwards.paid gave float32 of shape (); give float of shape (16, 3)"),
        ("dim=1).mean() +", "dim=1) +", "Upwards.loss gave shape [8]; give one number, such as its mean()"),
        ("return -(self", "return 0.0; -(self", "Upwards.loss gave a float; give a torch.Tensor"),
        ("return -(self", "return after.mean(); -(self", "Upwards.loss does not depend on the network that it is to"),
        ("self.network(before)\n", "self.network(before).numpy()\n", "RuntimeError: Can't call numpy() on Tensor"),
        ("- self.network(before)", "/ 0.0", "Upwards.loss gave nan"),  # and paid does then, too
        (
            "- self.network(before)",
            "/ (1.0 if self.network(after).requires_grad else 0.0) * 0.0",
            "Upwards.paid gave nan at [0, 0] of shape (16, 3)",
        ),
        ("class Upwards(IntrinsicReward)", "class Upwards", "upwards.py:Upwards: no class that derives from Intrin"),
        ("IntrinsicReward\n\nclass", "Gone\n\nclass", "upwards.py:2: ImportError: "),
        ("    def loss", NESTED, "Upwards.make_network: only torch.nn.Linear with torch.nn.ReLU between them can be"),
        ("    prior =", "    priors =", "Upwards.priors is no member of IntrinsicReward; did you mean 'prior'?"),
        ("    def loss", FORGETS, "Upwards: goes on otherwise after load_state(state()): tensors() has to have all"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_said_before_anything_is_learned(file, tmp_path, old, new, said):
    assert old in CODE
    file.write_text(CODE.replace(old, new))
    with pytest.raises(TandemError) as error:
        load_config(None, SMALL).begin(tmp_path, None)
    assert_one_line(error.value, said)


def test_an_error_while_it_learns_names_its_line(file, tmp_path):
    old = "return self.network(after) - self.network(before)"
    file.write_text(CODE.replace(old, f"{old} if before.abs().max() > 1.5 else 1 / 0"))
    with pytest.raises(ConfigError) as error:
        train(
            load_config(None, SMALL),
            RunDirectory(tmp_path / "run"),
            tmp_path / "registry",
            on_iteration=lambda metrics: None,
        )
    assert_one_line(error.value, "upwards.py:13: ZeroDivisionError")


def test_a_class_that_teaches_nothing_of_its_own_is_refused(file, tmp_path):
    file.write_text(CODE.replace("def loss", "def _loss").replace("def paid", "def _paid"))
    with pytest.raises(TandemError, match="Upwards has neither loss nor paid nor make_network: give one of them"):
        load_config(None, SMALL).begin(tmp_path, None)


def test_a_reward_that_needs_a_whole_batch_gets_one(file, tmp_path):
    """As of the nearest of all states in a batch."""
    whole = "assert len(before) in (12, 16)\n        return self.network(after)"
    file.write_text(CODE.replace("return self.network(after) -", f"{whole} -"))
    load_config(None, [*SMALL, "skills.batch_size=12"]).begin(tmp_path, None)


def test_what_the_class_says_is_not_chosen(file):
    config = load_config(None, ["method=skills", f"skills.method={file.name}", "skills.prior=normal"])
    with pytest.raises(ConfigError, match=r"skills.prior = 'normal': upwards.py says 'sphere'; leave it out"):
        config.begin("no registry here", None)


def test_a_prior_of_ours_is_not_chosen(file):
    with pytest.raises(TandemError) as error:
        load_config(None, ["method=skills", "skills.method=lsd", "skills.prior=uniform"])
    assert_one_line(error.value, "prior of lsd is normal, not 'uniform': leave it out")


def test_a_method_that_there_is_not(file):
    with pytest.raises(TandemError) as error:
        load_config(None, ["method=skills", "skills.method=metrra"])
    assert_one_line(error.value, "skills.method 'metrra': choose one of lsd, dads, diayn, metra, csf, or FILE.py:CLASS")


@pytest.mark.parametrize("word", ["way", "place"])
def test_a_network_that_leads_to_no_goal_says_so(file, tmp_path, word):
    """Or whoever plays the skills finds out."""
    file.write_text(f"""
import torch
from torch import nn
from service.methods.intrinsic_reward import IntrinsicReward

class Upwards(IntrinsicReward):
    zero_shot = {word!r}

    def make_network(self):
        return nn.Sequential(nn.Linear(6, 8), nn.ReLU(), nn.Linear(8, 1))

    def loss(self, before, after, skill):
        return self.network(torch.cat((after, skill), dim=1)).square().mean()

    def paid(self, before, after, skill):
        return self.network(torch.cat((after, skill), dim=1))[:, 0]
""")
    with pytest.raises(TandemError) as error:
        load_config(None, SMALL).begin(tmp_path / "registry", None)
    assert_one_line(error.value, f"make_network: maps 6 numbers to 1; with zero_shot = {word!r} it has to map the 3 of")
