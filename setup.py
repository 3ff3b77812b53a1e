"""Puts configs/ into the wheel, as service/configs. Everything else about the package is in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py


class BuildWithConfigs(build_py):
    """The usual build; of an editable install, configs/ stays where it is."""

    def run(self) -> None:
        """Build, and copy."""
        super().run()
        if not self.editable_mode:
            shutil.copytree("configs", Path(self.build_lib) / "service" / "configs", dirs_exist_ok=True)


setup(cmdclass={"build_py": BuildWithConfigs})
