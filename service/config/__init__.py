"""Configurations: one frozen pydantic tree for a run, whose other keys are those of its method.

Unknown keys are errors, every number has its range, and units are part of the names: ``_m`` metres, ``_s`` seconds,
``_kg`` kilograms, ``num_`` counts. ``load_config`` reads YAML and applies ``--set a.b=c`` overrides.
"""

from service.config.load import changed_config as changed_config
from service.config.load import dump_config as dump_config
from service.config.load import load_config as load_config
from service.config.load import parse_config as parse_config
from service.config.run import Config as Config
from service.config.run import RunConfig as RunConfig
from service.config.world import WorkspaceConfig as WorkspaceConfig
from service.config.world import WorldConfig as WorldConfig
