"""Policies with random parameters, published, and runs by hand."""

import torch

from service.config import RunConfig, WorldConfig
from service.config.self_play import MCPConfig, MLPConfig, PolicyConfig, SelfPlayConfig
from service.config.task import TaskConfig
from service.config.task_methods import TASK_METHODS
from service.envs.observations import layouts
from service.learner.sac_networks import GaussianActor
from service.policies.learned_policy import num_inputs
from service.policies.networks import export_parameters, make_bob
from service.registry.loading import load
from service.registry.publishing import publish
from service.store.checkpoints import CheckpointStore
from service.store.run_directory import RunDirectory

WORLD = WorldConfig(physics_step_s=0.005, num_substeps=8, observed={"num_commands": 2})
"""A world in which policies see more than in the paper."""
SEEN = layouts(WORLD)
BOB = MCPConfig(num_primitives=2, trunk_hidden_sizes=(24, 12), primitive_hidden_size=9, gate_hidden_sizes=(16,))
CONFIG = SelfPlayConfig(name="made", world=WORLD, policy=PolicyConfig(bob=BOB), run=RunConfig(evaluation_steps=4))
TWO_CUBES = CONFIG.model_copy(update={"world": WORLD.model_copy(update={"objects": ("cube", "cube")})})
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
        return scattered(make_bob(config.policy, layouts(config.world)))


def actor_of(method, seen=SEEN):
    """Of a policy of a task; it sets the weights of Bob's primitives, or acts by itself."""
    composed = BOB.num_primitives if TASK_METHODS[method].composes else 4
    with torch.random.fork_rng():
        torch.manual_seed(4)
        actor = GaussianActor(num_inputs(seen)[1], composed + (4 if TASK_METHODS[method].adds_action else 0), (16, 12))
        return scattered(actor)


def publish_bob(registry, parameters=None):
    """Publish a Bob as made@1, and load him."""
    publish(registry, CONFIG, parameters or parameters_of(CONFIG), {})
    return load("made@1", registry.root)


def write_training(path, trained, method="ours-residual-her", task="push"):
    """The run of a task at its end, as far as an export reads it."""
    config = TaskConfig(
        method=method,
        task=task,
        world=trained.config.world,
        primitives=trained.reference,
        primitives_digest=trained.digest if TASK_METHODS[method].takes else None,
    )
    return write_run(path, config, actor_of(method))


def write_run(path, config, parameters=None):
    """A run directory with one checkpoint."""
    directory = RunDirectory(path)
    directory.start(config)
    parameters = parameters or parameters_of(config)
    arrays = {f"{config.part}/{name}": array for name, array in parameters.items()}
    CheckpointStore(directory.checkpoints, keep=1).save(1, arrays, {"env_steps": 1})
    directory.close()
    return path
