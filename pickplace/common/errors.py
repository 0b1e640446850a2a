"""Errors in one sentence, for a person in front of a terminal."""

import argparse
import errno
import os
import re
import signal
import sys
from collections import defaultdict
from collections.abc import Collection
from contextlib import AbstractContextManager, contextmanager, suppress
from difflib import get_close_matches
from typing import Any, NoReturn

from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.validate import excerpt, reword_errors, short_text


class WorkerDied(Exception):
    """A collector worker process has died. Not an OSError: signal handling code elsewhere catches those."""


class Parser(argparse.ArgumentParser):
    """A parser of command lines that raises its errors as ``ValueError``.

    Args:
        options: the arguments of ``add_argument``, by the names of an option, such as ``"--cfg/-c"``.
        **settings: of the base class.
    """

    def __init__(self, options: dict[str, dict[str, Any]] | None = None, **settings):
        super().__init__(**settings)
        for names, arguments in (options or {}).items():
            self.add_argument(*names.split("/"), **arguments)

    def error(self, message: str) -> NoReturn:
        unknown = re.match("unrecognized arguments: ([^ =]*)", message)
        close = get_close_matches(unknown[1], self._option_string_actions, 1) if unknown else []
        raise ValueError(f"{message}; expected {close[0] if close else 'the arguments that --help shows'}.")


#: Errors caused by the user or the machine. Any other may be a fault of the program, and its type is printed too.
EXPECTED = (ValueError, OSError, FloatingPointError, WorkerDied, OmegaConfBaseException)

#: Greatest length of an error that is shown, and of a word in it; the middle of a longer one is left out.
MAX_LENGTH, MAX_WORD = 1_000, 300

#: A word in the name of a key.
WORD = re.compile("[^\\W_]+")

#: The remedies for some errors of the operating system; for the others it is another path.
REMEDIES = {
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "a place where you may read and write"),
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free space"),
}


@contextmanager
def one_sentence():
    """End the command with one sentence and exit code 2 on an error; ``HYDRA_FULL_ERROR=1`` shows the traceback.

    A command that a signal ended has the exit code 128 + its number: 130 after Ctrl-C, 143 after SIGTERM.
    """
    before = os.environ.get("HYDRA_FULL_ERROR", "0")
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let Hydra raise errors instead of printing them over many lines
    try:
        yield
        write_output()
    except KeyboardInterrupt as stop:  # a training that saved before gives the signal
        sys.exit(128 + (stop.args[0] if stop.args else signal.SIGINT))
    except BrokenPipeError:  # the reader of the output, such as head, has closed it
        sys.exit(141)
    except Exception as error:
        if before == "1":
            raise
        with suppress(OSError):  # a terminal that was closed
            sys.stderr.write(f"error: {sentence(error)}\n")
        sys.exit(2)
    finally:
        os.environ["HYDRA_FULL_ERROR"] = before
        with suppress(OSError):
            write_output()


def write_output(text: str = "") -> None:
    """Write to standard output and flush it.

    Raises:
        OSError: if that fails. The output is dropped then: the interpreter would try again, and print a traceback.
    """
    try:
        if sys.stdout is not None:
            encoding = sys.stdout.encoding or "utf-8"  # a name in a file may have letters that the terminal has not
            sys.stdout.write(text.encode(encoding, "backslashreplace").decode(encoding))
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OSError(error.errno, error.strerror, "standard output") from error


def sentence(error: Exception) -> str:
    """Return an error as one line of at most :data:`MAX_LENGTH` letters, without control characters."""
    text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in _sentence(error))
    text = re.sub(r"; use sys\.set_int_max_str_digits\(\) to increase the limit", "", text)
    text = re.sub(rf"\S{{{MAX_WORD},}}", lambda word: f"{word[0][:80]}...{word[0][-30:]}", text)
    half = MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[: half - 3]} ... {text[2 - half :]}"


def _sentence(error: Exception) -> str:
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}; expected {REMEDIES.get(error.errno or 0, 'another path')}."
    if isinstance(error, EXPECTED):
        noise = ("full_key", "object_type", "See https", "To append", "Config search path", "provider=")
        lines = [line.strip() for line in str(error).splitlines()]
        text = " ".join(line for line in lines if line and not line.startswith(noise)) or type(error).__name__
        key = getattr(error, "full_key", None)  # OmegaConf's
        return f"{key}: {text}" if key and key not in text else text
    return f"{type(error).__name__}: {' '.join(str(error).split())} (HYDRA_FULL_ERROR=1 shows where)"


def require_extra(group: str, extra: str) -> AbstractContextManager:
    """Raise an error that names the optional extra of a config group's option, if an import in the block fails."""
    return reword_errors(
        ImportError, lambda _: ValueError(f"{group}={extra}: {extra} is missing; pip install 'pickplace[{extra}]'.")
    )


def unknown_key(key: str, node: DictConfig | dict, prefix: str = "", others: Collection[str] = ()) -> str:
    """Return a sentence on a key that is not in a config; it lists the keys that are.

    Args:
        key: the whole key, such as ``algo.gama``.
        node: the config, or the part of it at ``prefix``.
        prefix: place of the part, with a dot at its end.
        others: full names of keys and groups that may be meant.
    """
    *parents, leaf = key.removeprefix(prefix).split(".")
    for parent in parents:
        if parent not in node:
            leaf = parent
            break
        if not isinstance(child := node.get(parent), DictConfig):
            place, value = short_text(prefix + parent), "null" if child is None else excerpt(child)
            return f"{short_text(key)}: {place} is {value}, without keys; expected an option that gives it some."
        prefix, node = f"{prefix}{parent}.", child
    known = [str(name) for name in node if name not in ("_target_", "hydra")]
    close = get_close_matches(leaf, known, 1) if prefix or not others else full_names(key, others)
    expected = f"expected one of {', '.join(known)}." if known else "expected no key."
    hint = f"did you mean {' or '.join(map(repr, close))}?" if close else expected
    return f"{short_text(key)}: there is no key {short_text(leaf)!r} in {prefix[:-1] or 'the config'}; {hint}"


def full_names(key: str, names: Collection[str]) -> list[str]:
    """Return up to four names of keys and groups that may be meant by a name that is misspelt or lacks its beginning.

    ``rotations`` and ``env.rotation`` mean ``env.rotations``, and ``frames`` any name that ends in it.
    """
    endings = defaultdict(list)
    for name in names:
        words = WORD.findall(name)
        for start in range(len(words)):
            endings["_".join(words[start:])].append(name)
    close = get_close_matches("_".join(WORD.findall(key)), endings, 1, 0.7)
    return [key] if key in names else endings[close[0]][:4] if close else []
