"""The formats: each writes a network into a folder, and reads it back to run it."""

from __future__ import annotations

import importlib
import logging
import runpy
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np

from service.base.errors import TandemError, did_you_mean, needs_extra
from service.base.types import FloatArray
from service.export.networks import Network, Outputs
from service.policies import forward

if TYPE_CHECKING:
    from torch import Tensor, nn

Run = Callable[..., Outputs]
PROGRAM = "policy.py"
"""The program of a folder of the format numpy."""
_NUM_EXAMPLES = 3
"""Rows of the input that torch follows through a network; not 1, which it would take for a size that is fixed."""


@dataclass(frozen=True, slots=True)
class Format:
    """A way to write networks down."""

    ending: str
    """Of its files' names."""
    write: Callable[[Network, Path], None]
    """Writes a network to a file, and beside it what it needs to run."""
    read: Callable[[Network, Path], Run]
    """Reads it back: a function of the network's inputs to its outputs."""
    needs: tuple[str, ...] = ()
    """Packages of the extra ``export``."""


def find_format(name: str) -> Format:
    """Find a format by its name.

    Raises:
        TandemError: no such format, or packages that it needs are not installed.
    """
    if name not in FORMATS:
        raise TandemError(f"unknown format {name!r}; choose one of {', '.join(FORMATS)}{did_you_mean(name, FORMATS)}")
    with needs_extra("export", f"the format {name}"):
        for package in FORMATS[name].needs:
            importlib.import_module(package)
    return FORMATS[name]


def _write_numpy(network: Network, path: Path) -> None:
    columns = {f"{forward.COLUMNS}{name}": [part.start, part.stop] for name, part in network.columns.items()}
    about = {"function": network.function, "input_sizes": list(network.inputs.values()), **columns}
    arrays: dict[str, Any] = {**network.parameters, **about}
    np.savez(path, allow_pickle=False, **arrays)
    (path.parent / PROGRAM).write_text(Path(forward.__file__).read_text(encoding="utf-8"), encoding="utf-8")


def _read_numpy(network: Network, path: Path) -> Run:
    """Run the folder's own copy of the program, not the package's module."""
    loaded: Run = runpy.run_path(str(path.parent / PROGRAM))["load"](path)
    return loaded


def _in_torch(network: Network) -> tuple[nn.Module, tuple[Tensor, ...]]:
    """The network in torch, its inputs to a tuple of its outputs in their order, and inputs to follow through it."""
    import torch
    from torch import nn

    function = forward.FUNCTIONS[network.function]

    def without_out(operation: Callable[..., Tensor]) -> Callable[..., Tensor]:
        return lambda *values, out=None: operation(*values)

    xp = SimpleNamespace(
        argsort=lambda values, axis, kind: values.sort(axis).indices,  # ONNX has no stable one; of few it is stable
        asarray=lambda array, dtype: array.to(dtype),
        ascontiguousarray=lambda array: array,  # a copy would be made at each call
        clip=torch.clip,
        concatenate=torch.concatenate,
        copy=torch.clone,
        exp=without_out(torch.exp),
        int64=torch.int64,
        maximum=without_out(lambda values, least: values.clip(min=least)),
        minimum=without_out(lambda values, most: values.clip(max=most)),
        repeat=torch.repeat_interleave,
        stack=torch.stack,
        take_along_axis=lambda values, places, axis: values.gather(axis, places.expand_as(values)),
        tanh=without_out(torch.tanh),
    )

    class _Module(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            for name, array in network.parameters.items():
                self.register_buffer(name.replace(".", "__"), torch.from_numpy(np.array(array)))

        def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
            stored = {name: getattr(self, name.replace(".", "__")) for name in network.parameters}
            outputs = function(xp, forward.prepared(xp, stored), network.columns, *inputs)
            return tuple(outputs[name] for name in network.outputs)

    return _Module().eval(), tuple(torch.zeros(_NUM_EXAMPLES, size) for size in network.inputs.values())


def _write_torchscript(network: Network, path: Path) -> None:
    import torch

    with torch.no_grad(), _quiet_torch():
        traced: Any = torch.jit.trace(*_in_torch(network))
        traced.save(str(path))


def _read_torchscript(network: Network, path: Path) -> Run:
    import torch

    with _quiet_torch():
        loaded: Any = torch.jit.load(str(path))

    def run(*inputs: FloatArray) -> Outputs:
        with torch.no_grad():
            found = loaded(*(torch.from_numpy(rows) for rows in inputs))
        return {name: tensor.numpy() for name, tensor in zip(network.outputs, found, strict=True)}

    return run


def _write_onnx(network: Network, path: Path) -> None:
    import torch

    num_rows = torch.export.Dim("N", min=1)
    with torch.no_grad(), _quiet_torch():
        torch.onnx.export(
            *_in_torch(network),
            path,
            input_names=list(network.inputs),
            output_names=list(network.outputs),
            dynamic_shapes=(({0: num_rows},) * len(network.inputs),),
            dynamo=True,
            external_data=False,
            verbose=False,
        )


def _read_onnx(network: Network, path: Path) -> Run:
    import onnxruntime

    session: Any = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])

    def run(*inputs: FloatArray) -> Outputs:
        found = session.run(list(network.outputs), dict(zip(network.inputs, inputs, strict=True)))
        return dict(zip(network.outputs, found, strict=True))

    return run


@contextmanager
def _quiet_torch() -> Iterator[None]:
    """Keep torch from telling of its own deprecations, of packages that are not needed here, and of every node."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


FORMATS = {
    "onnx": Format(".onnx", _write_onnx, _read_onnx, ("onnx", "onnxscript", "onnxruntime")),
    "numpy": Format(".npz", _write_numpy, _read_numpy),
    "torchscript": Format(".pt", _write_torchscript, _read_torchscript),
}
"""The formats by the names that commands take."""
