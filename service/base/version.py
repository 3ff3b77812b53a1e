"""The version of this package, which ``tests/test_project.py`` compares with the project file."""

__version__ = "0.3.0"
