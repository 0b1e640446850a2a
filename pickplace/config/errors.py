"""Errors in one sentence, for a person in front of a terminal."""

import argparse
import errno
import os
import re
import signal
import sys
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from typing import NoReturn

from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from pickplace.common.validate import excerpt, short_text


class JobFailed(Exception):
    """A run of a sweep failed; the message is one sentence. It crosses processes, which the error itself may not."""


class WorkerDied(Exception):
    """A collector worker process has died. Not an OSError: signal handling code elsewhere catches those."""


class Parser(argparse.ArgumentParser):
    """A parser of command lines that raises its errors."""

    def error(self, message: str) -> NoReturn:
        """Raise a ``ValueError``."""
        raise ValueError(f"{message}; expected the arguments that --help shows.")


#: Errors caused by the user or the machine. Any other may be a fault of the program, and its type is printed too.
EXPECTED = (ValueError, OSError, FloatingPointError, JobFailed, WorkerDied, HydraException, OmegaConfBaseException)

#: Greatest length of an error that is shown, and of a word in it; the middle of a longer one is left out.
MAX_LENGTH, MAX_WORD = 1_000, 300

#: Config files of Hydra plugins, and the optional extras that bring them.
EXTRAS = {"hydra/sweeper/optuna": "optuna", "hydra/launcher/joblib": "joblib", "hydra/launcher/submitit": "submitit"}


@contextmanager
def one_sentence():
    """End the command with one sentence and exit code 2 on an error; ``HYDRA_FULL_ERROR=1`` shows the traceback.

    A command that a signal ended has the exit code 128 + its number: 130 after Ctrl-C, 143 after SIGTERM.
    """
    shows_traceback = os.environ.get("HYDRA_FULL_ERROR") == "1"
    try:
        yield
        write_output()
    except KeyboardInterrupt as stop:  # its argument is the signal, of a training that saved before
        sys.exit(128 + (stop.args[0] if stop.args else signal.SIGINT))
    except BrokenPipeError:  # the reader of the output, such as head, has closed it
        sys.exit(141)
    except Exception as error:
        if shows_traceback:
            raise
        with suppress(OSError):  # a terminal that was closed
            sys.stderr.write(f"error: {sentence(error)}\n")
        sys.exit(2)
    finally:
        with suppress(OSError):
            write_output()


def write_output(text: str = "") -> None:
    """Write to standard output, now.

    Raises:
        OSError: if that fails. The output is dropped then: the interpreter would try again, and print a traceback.
    """
    try:
        if sys.stdout is not None:
            sys.stdout.write(text)
            sys.stdout.flush()
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        raise OSError(error.errno, error.strerror, "standard output") from error


def sentence(error: Exception) -> str:
    """Return an error as one line of at most :data:`MAX_LENGTH` letters, without those that control a terminal."""
    text = "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in _sentence(error))
    text = re.sub(r"; use sys\.set_int_max_str_digits\(\) to increase the limit", "", text)
    text = re.sub(rf"\S{{{MAX_WORD},}}", lambda word: f"{word[0][:80]}...{word[0][-30:]}", text)
    half = MAX_LENGTH // 2
    return text if len(text) <= MAX_LENGTH else f"{text[: half - 3]} ... {text[2 - half :]}"


def _sentence(error: Exception) -> str:
    if isinstance(error, OverrideParseException):
        reasons = [line for line in error.message.splitlines() if not line.startswith(("Error parsing", "See https"))]
        return f"{error.override!r}: expected <key>=<value> ({' '.join(reasons)})."
    if isinstance(error, MissingConfigException) and error.missing_cfg_file:
        for start, extra in EXTRAS.items():
            if error.missing_cfg_file.startswith(start):
                return f"{error.missing_cfg_file}: {extra} is missing; pip install 'pickplace[{extra}]'."
        if error.options:
            return f"{error.missing_cfg_file}: there is no such config; expected one of {', '.join(error.options)}."
    if isinstance(error, OSError) and error.filename and error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
        return f"{error.filename}: {error.strerror}; expected a place where you may read and write."
    if isinstance(error, OSError) and error.filename and error.errno in (errno.ENOSPC, errno.EDQUOT):
        return f"{error.filename}: {error.strerror}; expected free space."
    if isinstance(error, OSError) and error.filename and error.strerror:
        return f"{error.filename}: {error.strerror}; expected another path."
    if isinstance(error, EXPECTED):
        noise = ("full_key", "object_type", "See https", "To append", "Config search path", "provider=")
        lines = [line.strip() for line in str(error).splitlines()]
        text = " ".join(line for line in lines if line and not line.startswith(noise)) or type(error).__name__
        key = getattr(error, "full_key", None)  # OmegaConf's
        return f"{key}: {text}" if key and key not in text else text
    return f"{type(error).__name__}: {' '.join(str(error).split())} (HYDRA_FULL_ERROR=1 shows where)"


def missing_extra(group: str, extra: str) -> ValueError:
    """Return the error for an option of a config group whose optional extra is not installed."""
    return ValueError(f"{group}={extra}: {extra} is missing; pip install 'pickplace[{extra}]'.")


def unknown_key(key: str, node: DictConfig | dict, prefix: str = "") -> str:
    """Return a sentence on a key that is not in a config, with the keys that are.

    Args:
        key: the whole key, such as ``algo.gama``.
        node: the config, or the part of it at ``prefix``.
        prefix: place of the part, with a dot at its end.
    """
    *parents, leaf = key.removeprefix(prefix).split(".")
    for parent in parents:
        child = node.get(parent) if parent in node else None
        if not isinstance(child, DictConfig):
            if parent in node:
                place, value = short_text(prefix + parent), "null" if child is None else excerpt(child)
                return f"{short_text(key)}: {place} is {value}, without keys; expected an option that gives it some."
            leaf = parent
            break
        prefix, node = f"{prefix}{parent}.", child
    known = [str(name) for name in node if name not in ("_target_", "hydra")]
    close = get_close_matches(leaf, known, 1)
    expected = f"one of {', '.join(known)}" if known else "no key"
    hint = f"did you mean {close[0]!r}?" if close else f"expected {expected}."
    key, leaf = map(short_text, (key, leaf))
    return f"{key}: there is no key {leaf!r} in {prefix[:-1] or 'the config'}; {hint}"
