"""Policies with random parameters, published, and trainings by hand."""

import torch

from service.config import Config, MCPConfig, MLPConfig, PolicyConfig, RunConfig, WorldConfig
from service.downstream.directory import TrainingDirectory
from service.downstream.files import write_json
from service.downstream.methods import provenance
from service.downstream.settings import make_trial
from service.envs.observations import layouts
from service.io.checkpoints import CheckpointStore
from service.io.run_directory import RunDirectory
from service.policies.networks import export_parameters, make_bob
from service.primitives.learned import num_inputs, save_policy
from service.primitives.loading import load
from service.primitives.publishing import publish
from service.sac.networks import GaussianActor

WORLD = WorldConfig(physics_step_s=0.005, num_substeps=8, observed={"num_commands": 2})
"""A world in which policies see more than in the paper."""
SEEN = layouts(WORLD)
BOB = MCPConfig(num_primitives=2, trunk_hidden_sizes=(24, 12), primitive_hidden_size=9, gate_hidden_sizes=(16,))
CONFIG = Config(name="made", world=WORLD, policy=PolicyConfig(bob=BOB), run=RunConfig(evaluation_steps=4))
MONOLITHIC = CONFIG.model_copy(
    update={"policy": PolicyConfig(bob=BOB, monolithic_bob=MLPConfig(hidden_sizes=(20, 10)))}
)


def scattered(module):
    """Parameters of a network, each moved away from its initial value."""
    generator = torch.Generator().manual_seed(5)
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator), alpha=0.1)
    return export_parameters(module)


def parameters_of(config):
    with torch.random.fork_rng():
        torch.manual_seed(3)
        return scattered(make_bob(config.policy, SEEN))


def actor_of(residual):
    with torch.random.fork_rng():
        torch.manual_seed(4)
        actor = GaussianActor(num_inputs(SEEN)[1], BOB.num_primitives + (4 if residual else 0), (16, 12))
        return scattered(actor)


def publish_bob(registry, parameters=None):
    """Publish a Bob as made@1, and load him."""
    publish(registry, CONFIG, parameters or parameters_of(CONFIG), {})
    return load("made@1", registry.root)


def write_training(path, trained, method="ours-residual-her", task="push"):
    """The directory of a training at its end, as far as an export reads it."""
    training, trial = TrainingDirectory(path), make_trial(task=task, method=method)
    tree = {"format_version": 1, "cell": trial.model_dump(mode="json"), **provenance(trained, method)}
    write_json(training.trial_file, tree)
    save_policy(training.policy_file, actor_of("residual" in method), method, tree["primitives"])
    return training


def write_run(path, config):
    """A run directory with one checkpoint."""
    directory = RunDirectory(path)
    directory.start(config)
    arrays = {f"bob/{name}": array for name, array in parameters_of(config).items()}
    CheckpointStore(directory.checkpoints, keep=1).save(1, arrays, {"env_steps": 1})
    directory.close()
    return path
