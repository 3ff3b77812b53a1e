"""Python files of a user's: found by a reference, kept as text, and run under a name of their own.

A run records the text of what it uses. So the same text runs on workers and after a resume, whatever becomes of the
file. Nothing here is run unless somebody asks for it by ``find``.
"""

from __future__ import annotations

import contextlib
import importlib.util
import linecache
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from hashlib import sha256
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np

from service.base.errors import ConfigError, TandemError
from service.base.files import read_regular
from service.base.types import Array

Texts = Mapping[str, str]
"""Texts of files by their origins."""
PRIVATE = "tandem_user_"
"""Begins the names of the modules that such texts make."""
MAX_BYTES = 40_000
"""Of a file: it is in the configuration of a run, and in every checkpoint."""
_ALONE = "a file stands alone: put what it needs into it, or install that"
ALIKE = 0.8
"""Similarity of two names, by ``difflib``, of which one is likely the other one misspelt."""


class CodeError(ConfigError):
    """Code of a user's that does not run, or gives something else than is asked for; names its file and line."""


class Reference(NamedTuple):
    """A name in code of a user's."""

    origin: str
    """``FILE.py`` as it was given, or the name of a module."""
    name: str | None
    """None: the only one of its kind."""


def parse_reference(text: str) -> Reference | None:
    """Read ``FILE.py``, ``FILE.py:NAME`` or ``MODULE:NAME``; None where it is a name of ours."""
    if text.endswith(".py"):
        return Reference(text, None)
    origin, separator, name = text.rpartition(":")
    return Reference(origin, name) if separator and origin and name.isidentifier() else None


def text_of(origin: str) -> str:
    """The text of a file, or of a module that Python finds.

    Raises:
        CodeError: there is none, or it is no text of a sensible size.
    """
    path = Path(origin)
    if path.suffix != ".py":
        try:
            spec = importlib.util.find_spec(origin)
        except (ImportError, ValueError):
            spec = None
        except Exception as error:  # of a package above it, which is imported
            raise CodeError(f"{origin}: {type(error).__name__}: {' '.join(str(error).split())}") from error
        if spec is None or spec.origin is None or not spec.origin.endswith(".py"):
            raise CodeError(f"{origin}: no module of that name with Python code; write FILE.py:NAME or MODULE:NAME")
        path = Path(spec.origin)
    try:
        return read_regular(path, MAX_BYTES, follow=True).decode("utf-8-sig")
    except FileNotFoundError:
        raise CodeError(f"{path.absolute()}: no such file; write FILE.py, FILE.py:NAME or MODULE:NAME") from None
    except OSError as error:
        raise CodeError(f"{origin}: {error.strerror}; name a shorter file, or one that can be read") from None
    except UnicodeDecodeError as error:
        raise CodeError(f"{origin}: no UTF-8 text ({error.reason}); save it as UTF-8") from None


def find(reference: Reference, texts: Texts, kind: Callable[[object], bool], what: str) -> Any:
    """Run a text, and give what the reference names in it.

    Args:
        reference: without a name: the only one of its kind.
        texts: has that of its origin, or else that is read.
        kind: tells what is one.
        what: a word for one, such as ``task``, for errors.

    Raises:
        CodeError: it does not run, or has no such thing.
    """
    module = run(reference.origin, texts.get(reference.origin) or text_of(reference.origin))
    known = [name for name, each in vars(module).items() if not name.startswith("_") and kind(each)]
    if reference.name is None:
        if len(known) != 1:
            there = (
                f"{len(known)} of them: {', '.join(known)}; write {reference.origin}:NAME" if known else "none of it"
            )
            method = f"; a method of yours goes by --method {reference.origin}" if what == "task" and not known else ""
            raise CodeError(f"{reference.origin}: it has to define one {what}, and has {there}{method}")
        return getattr(module, known[0])
    if reference.name not in known:
        there = f"there is {', '.join(known)}" if known else "there is none in this file"
        raise CodeError(f"{reference.origin}:{reference.name}: no {what} of that name; {there}")
    return getattr(module, reference.name)


def run(origin: str, text: str) -> ModuleType:
    """The module that a text makes, run once in a process, under a name that no other has.

    Raises:
        CodeError: it does not run.
    """
    name = f"{PRIVATE}{sha256(f'{origin} {text}'.encode()).hexdigest()[:16]}"
    if name in sys.modules:
        return sys.modules[name]
    module = ModuleType(name)
    module.__file__ = origin
    # what is recorded may differ from what the file has by now: tracebacks show what runs
    linecache.cache[origin] = (len(text), None, text.splitlines(keepends=True), origin)
    sys.modules[name] = module
    try:
        # stdout has what was asked of a command, such as JSON
        with naming_errors_of(origin), contextlib.redirect_stdout(sys.stderr):
            exec(compile(text, origin, "exec", dont_inherit=True), vars(module))
            _stands_alone(module, origin)
    except BaseException:  # a second try is none of the half that ran
        del sys.modules[name]
        raise
    return module


def _stands_alone(module: ModuleType, origin: str) -> None:
    """Refuse a module, function or class that a text has from a file beside its own, which a run does not record.

    A module of an installed package may use others of it. What is imported within a function is not seen.
    """
    here = Path(origin).resolve().parent
    if not origin.endswith(".py") or (here / "__init__.py").exists() or here.name.endswith("-packages"):
        return
    for value in list(vars(module).values()):
        name = value.__name__ if isinstance(value, ModuleType) else getattr(value, "__module__", None)
        file = getattr(sys.modules.get(name), "__file__", None) if isinstance(name, str) else None
        if file is not None and name not in (module.__name__, "__main__") and Path(file).resolve().parent == here:
            raise CodeError(f"{origin}: it has {name} from {file}; {_ALONE}")


@contextmanager
def naming_errors_of(origin: str) -> Iterator[None]:
    """Say of any error inside, in one line, where in the code of ``origin`` it comes from."""
    try:
        yield
    except CodeError:
        raise
    except (Exception, SystemExit) as error:
        lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == origin]
        said = " ".join(str(error).split())
        if isinstance(error, SyntaxError) and error.filename == origin:  # and not of what it imports
            lines, said = [error.lineno], error.msg
        where = f"{origin}:{lines[-1]}" if lines else origin
        if isinstance(error, ModuleNotFoundError) or (isinstance(error, ImportError) and "relative import" in said):
            said += f"; {_ALONE}"
        raise CodeError(f"{where}: {type(error).__name__}{': ' * bool(said)}{said}") from error


@contextmanager
def naming_unexpected(origin: str | None) -> Iterator[None]:
    """As ``naming_errors_of``, but for errors of which the code is not the cause; None: it is not a user's."""
    try:
        yield
    except (TandemError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        its_own = any(frame.filename == origin for frame in traceback.extract_tb(error.__traceback__))
        if origin is None or (isinstance(error, OSError | SystemExit) and not its_own):
            raise
        with naming_errors_of(origin):
            raise


def origin_of(kind: type) -> str | None:
    """The file of a class that ``find`` gave; None of any other."""
    return sys.modules[kind.__module__].__file__ if kind.__module__.startswith(PRIVATE) else None


def checked(where: str, given: Array, shape: tuple[int, ...], *, truth: bool = False) -> Array:
    """What code of a user's gave, as bool or float64, if it is of that shape and finite.

    Args:
        where: it came from, such as ``my_task.py:7: success``.
        given: the array.
        shape: that it has to have.
        truth: whether it has to be bool; else any numbers will do.

    Raises:
        CodeError: it is something else.
    """
    is_real = np.issubdtype(given.dtype, np.integer) or np.issubdtype(given.dtype, np.floating)
    fits = given.dtype == np.bool_ or (is_real and not truth)
    if given.shape != shape or not fits:
        wanted = f"{'bool' if truth else 'float'} of shape {shape}"
        raise CodeError(f"{where} gave {given.dtype} of shape {given.shape}; give {wanted}")
    if not np.isfinite(given).all():
        place = tuple(int(each) for each in np.argwhere(~np.isfinite(given))[0])
        raise CodeError(f"{where} gave {given[place]} at {list(place)} of shape {shape}; give finite numbers")
    return given if truth else given.astype(np.float64)


def shown(array: Array) -> Array:
    """The same, not to be written to: what code of a user's changed in it would change what is played."""
    seen = array.view()
    seen.flags.writeable = False
    return seen


def place_of(function: object) -> tuple[str, str]:
    """The file of a function, also of a partial one, and ``FILE.py:LINE``; its name where Python has no more."""
    function = getattr(function, "func", function)
    called = getattr(type(function), "__call__", None)  # noqa: B004 - of an object that can be called
    code = getattr(function, "__code__", None) or getattr(called, "__code__", None)
    return (code.co_filename, f"{code.co_filename}:{code.co_firstlineno}") if code else (repr(function),) * 2


def changed_since(texts: Texts) -> list[str]:
    """Origins of files that have another text by now; one that is gone has not changed."""
    changed = []
    for origin, text in texts.items():
        with suppress(CodeError):
            changed += [origin] * (text_of(origin) != text)
    return changed


def find_class(named: str, texts: Texts, base: type) -> Any:
    """``find`` a class that derives from ``base``, and is none of ours."""
    reference = parse_reference(named)
    assert reference is not None, "the configuration has checked it"

    def is_own(found: object) -> bool:
        return isinstance(found, type) and issubclass(found, base) and not found.__module__.startswith("service.")

    return find(reference, texts, is_own, f"class that derives from {base.__name__}")


def check_members(kind: type, base: type, replaceable: Sequence[str]) -> None:
    """Refuse a class of a user's that misspells a member of its base: the base's own would be used in its place.

    Args:
        kind: the class.
        base: its base.
        replaceable: members of the base that a class may have of its own.

    Raises:
        CodeError: it has a public member that is spelt almost like one of these, which it has not.
    """
    from difflib import get_close_matches

    own = {name for each in kind.__mro__ if origin_of(each) is not None for name in vars(each)}
    known = [name for name in replaceable if name not in own]
    for name in sorted(own - {*dir(base)}):
        if not name.startswith("_") and (like := get_close_matches(name, known, n=1, cutoff=ALIKE)):
            raise CodeError(
                f"{origin_of(kind)}: {kind.__name__}.{name} is no member of {base.__name__}; did you mean "
                f"{like[0]!r}? The name of a helper of your own begins with an underscore"
            )


def recorded(reference: str, texts: Texts) -> Texts:
    """``texts``, and that of the file that a reference names, unless it is there; a name of ours needs none.

    Raises:
        CodeError: no such file or module.
    """
    found = parse_reference(reference)
    if found is None or found.origin in texts:
        return texts
    return {**texts, found.origin: text_of(found.origin)}
