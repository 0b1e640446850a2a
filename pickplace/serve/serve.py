"""The ``pickplace-serve`` command: a planner behind HTTP, with a live page of the last plans."""

import argparse
import ipaddress
import os
import socket

from pickplace.common.errors import Parser, one_sentence, write_output
from pickplace.common.interrupts import import_quietly
from pickplace.common.validate import excerpt, number, refuse_if, short_text, whole_number
from pickplace.serve.decisions import DecisionLog, service_facts
from pickplace.serve.options import load_planner, plan_once, planner_options

TOKEN = "PICKPLACE_TOKEN"  # an environment variable, as every user of the machine can read a command line
MIN_TOKEN = 16  # fewest characters


@one_sentence()
def main() -> None:
    """Entry point of ``pickplace-serve``."""
    options = parser().parse_args()
    import_quietly("pickplace.robot.planner")
    run(options)


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    return Parser(
        prog="pickplace-serve",
        description="Answer requests over HTTP: POST /plan takes what pickplace-plan reads as a line, and / shows the "
        "last plans in 3D. Without a token it serves this machine only.",
        epilog=f"The environment variable {TOKEN} holds the token. Requests, errors and limits: docs/service.md",
        options={
            **planner_options(),
            "--host": {
                "default": "127.0.0.1", "help": "address to listen at (default %(default)s); others need a token",
            },
            "--port": {
                "type": int, "default": 8000, "help": "port to listen at, or 0 for a free one (default %(default)s)",
            },
            "--allow-host": {
                "action": "append", "metavar": "NAME", "default": [],
                "help": "a further name by which clients call this machine; may be repeated",
            },
            "--rate": {
                "type": float, "metavar": "N", "default": 600,
                "help": "most plans a minute, of all clients (default %(default)s)",
            },
            "--history": {
                "type": int, "metavar": "N", "default": 20, "help": "plans that the page shows (default %(default)s)",
            },
            "--log": {
                "metavar": "FILE", "help": "file to append each request and plan to, for pickplace-plan --replay",
            },
        },
    )  # fmt: skip


def run(args: argparse.Namespace) -> None:
    """Load the planner and serve it until Ctrl-C.

    Raises:
        ValueError: for arguments, a token, an address or a checkpoint that cannot be used, or a missing extra.
    """
    token = checked_token(args.host)
    whole_number("--port", args.port, 0, 65_535)
    number("--rate", args.rate, 1, 1e6)
    whole_number("--history", args.history, 1, 1000)
    try:
        import uvicorn

        from pickplace.serve.connections import Connection
        from pickplace.serve.service import make_app
    except ImportError as error:
        if (error.name or "").startswith("pickplace"):
            raise
        raise ValueError(f"pickplace-serve: {error.name} is missing; pip install 'pickplace[serve]'.") from error

    planner, defaults = load_planner(args)
    plan_once(planner)
    log = None if args.log is None else DecisionLog(args.log, service_facts(planner, args))
    host = f"[{args.host}]" if ":" in args.host else args.host
    # The names by which clients may call the service. A foreign page whose name leads to this machine (DNS rebinding)
    # uses another name. If the service listens at all addresses and no name is given, any name is accepted: the token
    # is needed anyway, and the page lacks it.
    is_any = args.host in ("0.0.0.0", "::") and not args.allow_host
    hosts = ["*"] if is_any else ["localhost", "127.0.0.1", "[::1]", host, *args.allow_host]
    name = args.planner or "policy"
    app = make_app(planner, defaults, name, args.checkpoint, token, args.rate, args.history, hosts, log)
    family = socket.AF_INET6 if ":" in args.host else socket.AF_INET
    try:
        listener = socket.create_server((args.host, args.port), family=family)
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or str(error)
        raise ValueError(
            f"--host={excerpt(args.host)} --port={args.port}: {reason}; expected an address of this machine and a free "
            "port."
        ) from error
    write_output(f"Listening at http://{host}:{listener.getsockname()[1]}; Ctrl-C ends it.\n")
    config = uvicorn.Config(
        app, http=Connection, ws="none", log_level="warning", access_log=False, server_header=False,
        timeout_graceful_shutdown=3,
    )  # fmt: skip
    uvicorn.Server(config).run(sockets=[listener])


def is_local(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def checked_token(host: str) -> str | None:
    """Return the token that clients must send; None if there is no token and only this machine is served.

    Raises:
        ValueError: for another host without a token, or a token that is too short or no ASCII.
    """
    token = os.environ.get(TOKEN)
    refuse_if(
        token is None and not is_local(host),
        f"--host={short_text(host)}: other machines can reach it; expected a token in the environment variable "
        f"{TOKEN}, or --host 127.0.0.1.",
    )
    refuse_if(
        token is not None
        and (len(token) < MIN_TOKEN or not token.isascii() or not token.isprintable() or " " in token),
        f"{TOKEN}: got {len(token or '')} characters; expected at least {MIN_TOKEN}, printable ASCII without spaces.",
    )
    return token
