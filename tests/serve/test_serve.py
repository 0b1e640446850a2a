"""``pickplace-serve``: a real server in a thread or in a process of its own, asked by a real client."""

import http.client
import json
import logging
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path

import pytest
from browser import errors, wait_until
from commands import FORKSERVER, write_to

from pickplace import Planner, Scene, __version__, cli
from pickplace.serve import serve

pytest.importorskip("fastapi")
uvicorn = pytest.importorskip("uvicorn")

ROOT = Path(__file__).resolve().parents[2]
TOKEN = "a-token-of-many-letters"
GRID = {"bin_depth": [[0] * 5, [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0] * 5, [0] * 5], "tote_depth": [[5] * 6] * 6}


class Client:
    """One server, called through ``http.client``.

    Args:
        port: the server's.
        server: that of uvicorn, if it runs in this process.
    """

    def __init__(self, port, server=None):
        self.port, self.server = port, server

    def ask(self, method, path, body=None, **headers):
        """Return status, headers and the answer: from JSON, or as text."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        if body is not None:
            headers = {"Content-Type": "application/json", **headers}
            body = body if isinstance(body, bytes) else json.dumps(body).encode()
        headers = {key.replace("_", "-"): value for key, value in headers.items()}
        connection.request(method, path, body, headers)
        reply = connection.getresponse()
        text = reply.read().decode()
        connection.close()
        is_json = reply.headers.get_content_type() == "application/json"
        return reply.status, reply.headers, json.loads(text) if is_json else text

    def plan(self, body, **headers):
        return self.ask("POST", "/plan", body, **headers)


class Log(logging.Handler):
    """Keeps what is logged."""

    def __init__(self):
        super().__init__()
        self.lines = []

    def emit(self, record):
        self.lines.append(record.getMessage())


@contextmanager
def served(*arguments, token=None, logged=()):
    """Run ``pickplace-serve`` in a thread, on a free port; it must log these lines and no others."""
    run, log, started = uvicorn.Server.run, Log(), []

    def start(server, sockets):
        thread = threading.Thread(target=run, args=(server, sockets), daemon=True)
        thread.start()
        started.extend((server, sockets[0].getsockname()[1], thread))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(uvicorn.Server, "run", start)
        patch.delenv(serve.TOKEN, raising=False)
        if token:
            patch.setenv(serve.TOKEN, token)
        serve.run(serve.parser().parse_args([*map(str, arguments), "--port", "0"]))
    server, port, thread = started
    loggers = [logging.getLogger(name) for name in ("uvicorn", "asyncio")]
    for logger in loggers:
        logger.addHandler(log)
    try:
        yield Client(port, server)
    finally:
        server.should_exit = True  # as Ctrl-C
        thread.join(30)
        for logger in loggers:
            logger.removeHandler(log)
    assert not thread.is_alive() and log.lines == [*logged]


@pytest.fixture(scope="module")
def client():
    with served("pretrained/r4", "--history", 3, "--rate", 1e6) as client:
        yield client


def test_a_plan_is_that_of_the_planner(client):
    status, _, reply = client.plan({"id": "a", **GRID, "alternatives": 2})
    expected = Planner.load("pretrained/r4").plan(Scene.from_maps(**GRID), alternatives=2).as_dict()
    assert status == 200 and reply == {"id": "a", **json.loads(json.dumps(expected))}
    metres = {"items": [{"x": 0.1, "y": 0.12, "w": 0.09, "d": 0.04, "h": 0.05, "yaw": 20}], "cell_size": 0.05}
    status, _, reply = client.plan({**metres, "tote_depth": [[0.25] * 6] * 6})
    assert status == 200 and reply["status"] == "ok" and reply["box"]["yaw"] == pytest.approx(20)


def test_weights_of_another_model_and_tote_are_served():
    scene = {**GRID, "tote_depth": [[8] * 7 + [5]] * 8}
    with served("pretrained/mixed") as client:
        status, _, reply = client.plan({**scene, "alternatives": 2})
    expected = Planner.load("pretrained/mixed").plan(Scene.from_maps(**scene), alternatives=2).as_dict()
    assert status == 200 and len(reply["alternatives"]) == 2
    assert reply == json.loads(json.dumps(expected))


def serve_forever(output):
    """Run the command in this process, with a token."""
    write_to(output)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ[serve.TOKEN] = TOKEN
    sys.argv = ["pickplace-serve", "--planner", "joint_dbl", "--port", "0", "--threads", "1"]
    cli.serve()


def test_the_command_listens_until_ctrl_c(tmp_path):
    process, out = FORKSERVER.Process(target=serve_forever, args=(tmp_path,)), tmp_path / "stdout"
    process.start()
    try:
        wait_for(lambda: out.exists() and out.read_text().endswith("Ctrl-C ends it.\n"), seconds=60)
        client = Client(
            int(re.fullmatch(r"Listening at http://127\.0\.0\.1:(\d+); Ctrl-C ends it\.\n", out.read_text())[1])
        )
        assert client.plan(GRID)[0] == 401
        assert client.plan(GRID, Authorization=f"Bearer {TOKEN}")[2]["status"] == "ok"
        os.kill(process.pid, signal.SIGINT)
        process.join(30)
        assert (process.exitcode, (tmp_path / "stderr").read_text()) == (130, "")
    finally:
        process.kill()


def test_the_client_of_the_docs(client):
    command = [sys.executable, ROOT / "docs/examples/plan_client.py", f"http://127.0.0.1:{client.port}"]
    assert json.loads(subprocess.run(command, check=True, capture_output=True).stdout)["status"] == "ok"
    command[-1] += "/elsewhere"
    assert json.loads(subprocess.run(command, check=True, capture_output=True).stdout) == {"error": "Not Found"}


def test_the_client_of_the_docs_meets_another_program():
    class Busy(BaseHTTPRequestHandler):
        def do_POST(self):  # noqa: N802
            self.send_error(503, "Full")

        def log_message(self, *_):
            pass

    with HTTPServer(("127.0.0.1", 0), Busy) as server:
        threading.Thread(target=server.handle_request, daemon=True).start()
        url = f"http://127.0.0.1:{server.server_port}"
        command = [sys.executable, ROOT / "docs/examples/plan_client.py", url]
        answer = json.loads(subprocess.run(command, check=True, capture_output=True).stdout)
    wanted = "HTTP Error 503: Full, and no JSON; expected the address of pickplace-serve."
    assert answer == {"error": f"{url}: {wanted}"}


def test_health_says_what_is_served(client):
    status, _, health = client.ask("GET", "/health")
    assert status == 200 and (health["version"], health["checkpoint"]) == (__version__, "pretrained/r4")
    assert health["planner"] == "policy" and health["cell"]["tote_size"] == [6, 6, 5]
    assert health["cell"]["reach"] == "everywhere"


def test_health_says_no_more_of_a_reach_than_its_kind(tmp_path):
    """It needs no token."""
    rows = [f"bin,{x},{y},,," for x in range(5) for y in range(5)]
    rows += [f"tote,{x},{y},{r},," for x in range(6) for y in range(6) for r in range(4)]
    (tmp_path / "poses.csv").write_text("\n".join(["where,x,y,rotation,lowest,highest", *rows]))
    (tmp_path / "table.yaml").write_text(f"reach: {{_target_: table, path: {tmp_path}/poses.csv}}")
    for file, kind in ((tmp_path / "table.yaml", "table"), (ROOT / "conf/reach/annulus.yaml", "annulus")):
        with served("--planner", "joint_dbl", "--reach", file, token=TOKEN) as client:
            assert client.ask("GET", "/health")[2]["cell"]["reach"] == kind


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        (b"{", 400, "the request is not JSON"),
        (b"\xff", 400, "the request is not JSON"),
        (b"[1]", 400, "got list, expected an object"),
        (b'{"tote_depth": NaN}', 400, "NaN"),
        ({"tote_depth": [[5]]}, 422, "bin_depth: missing"),
        ({**GRID, "depth": 1}, 422, "depth: there is no such key"),
        ({**GRID, "tote_depth": [[5] * 6] * 5}, 422, "tote_depth"),
        ({**GRID, "alternatives": -1}, 422, "alternatives=-1: expected"),
        (b"[" + b"[]," * 300_000 + b"1]", 400, "300,001 lists, rows of maps included; expected at most 2,030"),
        (b'{"tote_depth": [[5]], "tote_depth": [[5]]}', 400, "'tote_depth' stands twice"),
        ({**GRID, "deadline": 0}, 422, "deadline=0: expected seconds between 0.001 and 3600"),
        ({**GRID, "exclude": {}}, 422, "exclude={}: expected"),
        ({**GRID, "exclude": [[1]]}, 422, "exclude[0]=[1]: expected numbers x, y or x, y, z"),
        (b" " * 2_884_000, 413, "2,883,872 bytes"),
    ],
)
def test_bad_requests_have_one_sentence(client, body, status, message):
    got, _, reply = client.plan(body)
    assert got == status and set(reply) == {"error"} and message in reply["error"]


def test_strangers_pages_are_refused(client):
    """Forms of other sites, and names that lead to this machine (DNS rebinding)."""
    for kind in ("text/plain", "application/x-www-form-urlencoded", ""):
        assert client.plan(json.dumps(GRID).encode(), Content_Type=kind)[0] == 415
    assert client.plan(GRID, Content_Type="application/json; charset=utf-8")[0] == 200
    for path in ("/health", "/plans", "/"):
        for host in ("evil.example", "localhost.evil.example:80", "127.0.0.1:80:80", "", "\xe9"):
            status, headers, reply = client.ask("GET", path, Host=host)
            assert status == 400 and set(reply) == {"error"} and "Host: got" in reply["error"]
        status, headers, _ = client.ask("GET", path, Host="localhost", Origin="http://evil.example")
        assert status == 200 and "Access-Control-Allow-Origin" not in headers
    assert client.ask("GET", "/plan")[0] == 405 and client.ask("GET", "/docs")[0] == 404
    assert set(client.ask("GET", "/none")[2]) == {"error"}


def test_the_page_gets_the_last_answers_in_cells(client):
    before = client.ask("GET", "/plans")[2]["last"]
    box = {"x": 0.1, "y": 0.125, "w": 0.08, "d": 0.04, "h": 0.05}
    metres = {"items": [box], "coming": [{**box, "h": 0.07}], "cell_size": 0.05}
    depth = [[0.25 - 0.05 * (x < 10 and y < 5) for y in range(30)] for x in range(30)]
    for body in (GRID, {**metres, "tote_depth": depth}, {"id": "<b>", "tote_depth": [[5]]}):
        client.plan(body)
    _, _, news = client.ask("GET", f"/plans?after={before}")
    first, second, third = news["plans"]
    assert news["last"] == third["number"] == before + 3 and news["most"] == 3
    assert first["scene"]["item"] == [2, 2.5, 2, 1, 1, 0] and first["scene"]["heights"] == [[0] * 6] * 6
    assert second["scene"]["item"] == pytest.approx([2, 2.5, 1.6, 0.8, 1, 0])
    assert first["scene"]["coming"] == [] and second["scene"]["coming"] == [[0.08, 0.04, 0.07]]
    heights = second["scene"]["heights"]
    assert len(heights) == 30 and sum(map(sum, heights)) == pytest.approx(50) and heights[9][4] == pytest.approx(1)
    x, y, z, _ = second["scene"]["place"]
    assert 0 < x < 6 and 0 < y < 6 and second["scene"]["height"] == pytest.approx(5) and z > second["scene"]["rest"]
    assert (third["status"], third["scene"], third["id"]) == ("refused", None, "'<b>'")
    assert client.ask("GET", "/plans")[2]["plans"][0]["number"] == before + 1  # of the last three
    assert client.ask("GET", "/plans?after=x")[0] == 422


def test_openapi_describes_requests_and_answers(client):
    from dataclasses import fields

    from pickplace.robot.planner import Plan
    from pickplace.serve.request import PlanRequest

    status, _, described = client.ask("GET", "/openapi.json")
    schemas = described["components"]["schemas"]
    assert status == 200 and set(schemas["PlanRequest"]["properties"]) == {key.name for key in fields(PlanRequest)}
    assert set(schemas["Plan"]["properties"]) == {field.name for field in fields(Plan)}
    references = set(json.dumps(described).split('"#/components/schemas/')[1:])
    assert {reference.partition('"')[0] for reference in references} <= set(schemas)
    for example in schemas["PlanRequest"]["examples"]:
        assert client.plan(example)[2]["status"] == "ok"
    defaults = {key: entry.get("default") for key, entry in schemas["PlanRequest"]["properties"].items()}
    parsed = vars(serve.parser().parse_args([]))
    assert all(defaults[key] == parsed[key] for key in ("accuracy", "clearance", "alternatives"))


def open_sockets(client, count, text):
    """Return connections over which each a text was sent; their buffers are small."""
    sockets = []
    for _ in range(count):
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
        one.settimeout(20)
        one.connect(("127.0.0.1", client.port))
        one.sendall(text)
        sockets.append(one)
    return sockets


def wait_for(condition, seconds=20):
    """Wait until a condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)


def is_ended(one):
    """Return whether the server ends a connection, after what it had written."""
    one.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2**20)
    try:
        while one.recv(2**16):
            pass
    except ConnectionError:
        pass
    except TimeoutError:
        return False
    return True


@pytest.fixture
def impatient(monkeypatch):
    """Servers wait less long for their clients."""
    monkeypatch.setattr("pickplace.serve.connections.CLIENT_SECONDS", 0.4)


LINE = b"GET /health HTTP/1.1\r\n"
FIRST = LINE + b"Host: localhost\r\n\r\n"
LONG = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: text/plain\r\nContent-Length: 9999\r\n\r\n"
PAGES = FIRST.replace(b"/health", b"/") * 1000  # answers of many megabytes, for a client that reads none of them


@pytest.mark.parametrize("text", [b"", LINE, FIRST + LINE, LONG, PAGES], ids=["", "line", "second", "body", "answer"])
def test_clients_that_stop_are_cut_off(text, impatient):
    """In the headers of the first request or of a later one, in a body that was refused, or while they are answered.

    A byte now and then does not help; nor do they keep others out.
    """
    with served("--planner", "joint_dbl") as client:
        sockets = open_sockets(client, 40, text)
        for _ in range(3):
            assert client.ask("GET", "/health")[0] == client.plan(GRID)[0] == 200

        def are_cut_off():
            for one in sockets if text != PAGES else ():
                with suppress(ConnectionError):
                    one.sendall(b"x")
            return not client.server.server_state.connections

        wait_for(are_cut_off)
        assert client.ask("GET", "/health")[0] == 200
        assert all(map(is_ended, sockets))


def test_idle_connections_keep_nobody_out():
    """Those that wait the longest go first; one whose plan is computed stays."""
    with served("--planner", "joint_dbl", "--rate", 1e6) as client:
        idle = open_sockets(client, 32, b"")
        for one in idle[16:]:
            one.sendall(FIRST)
        assert [client.plan(GRID)[0] for _ in range(10)] == [200] * 10
        wait_for(lambda: is_ended(idle[0]))
        assert len(client.server.server_state.connections) <= 32
        newest = open_sockets(client, 1, FIRST)[0]
        reply = http.client.HTTPResponse(newest)
        reply.begin()
        assert reply.status == 200
        for one in (*idle, newest):
            one.close()


def test_more_requests_than_connections_are_put_off(monkeypatch):
    """All of them are being answered: none can be ended for another."""
    monkeypatch.setattr("pickplace.serve.connections.CONNECTIONS", 4)
    head = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n{"
    with served("--planner", "joint_dbl") as client:
        sockets = open_sockets(client, 4, head)
        wait_for(lambda: sum(each.cycle is not None for each in list(client.server.server_state.connections)) == 4)
        status, headers, reply = client.ask("GET", "/health")
        assert status == 503 and set(reply) == {"error"} and headers["Retry-After"] == "1"
        for one in sockets:
            one.close()
        wait_for(lambda: client.ask("GET", "/health")[0] == 200)


def test_a_request_with_two_lengths_is_refused():
    """A proxy in front may read another request than the service: request smuggling."""
    body = b"5\r\nhello\r\n0\r\n\r\n"
    head = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Length: %d\r\nTransfer-Encoding: chunked\r\n\r\n"
    with served("--planner", "joint_dbl") as client:
        (one,) = open_sockets(client, 1, head % len(body) + body)
        reply = http.client.HTTPResponse(one)
        reply.begin()
        assert reply.status == 400 and "got both, expected one" in json.loads(reply.read())["error"]
        assert is_ended(one)


def test_a_client_may_wait_and_begin_anew(monkeypatch, impatient):
    """For a plan longer than it may take for its headers, and with a body that comes late, on one connection."""
    plan = Planner.plan
    monkeypatch.setattr(Planner, "plan", lambda *given, **named: time.sleep(0.7) or plan(*given, **named))
    with served("--planner", "joint_dbl") as client:
        body = json.dumps(GRID).encode()
        head = (
            f"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
        )
        (one,) = open_sockets(client, 1, head.encode() + b"\r\n\r\n")
        for _ in range(2):
            time.sleep(0.7)
            one.sendall(body)
            reply = http.client.HTTPResponse(one)
            reply.begin()
            assert reply.status == 200 and json.loads(reply.read())["status"] == "ok"
            one.sendall(head.encode())
            time.sleep(0.1)
            one.sendall(b"\r\n\r\n")
        one.close()


def test_a_client_may_ask_again_and_again(impatient):
    with served("--planner", "joint_dbl") as client:
        (one,) = open_sockets(client, 1, b"")
        for _ in range(12):
            time.sleep(0.05)
            one.sendall(FIRST)
            reply = http.client.HTTPResponse(one)
            reply.begin()
            assert reply.status == 200 and reply.read()
        one.close()


def test_slow_bodies_take_up_places():
    head = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n{"
    with served("--planner", "joint_dbl", "--rate", 1e6) as client:
        sockets = open_sockets(client, 20, head)
        wait_for(lambda: client.plan(GRID)[0] == 429)
        status, headers, reply = client.plan(GRID)
        assert status == 429 and headers["Retry-After"] == "1" and "too many plans" in reply["error"]
        for one in sockets:
            one.close()
        wait_for(lambda: client.plan(GRID)[0] == 200)


def test_a_refused_body_has_spent_its_plan():
    with served("--planner", "joint_dbl", "--rate", 3) as client:
        assert [client.plan(body)[0] for body in (b"{", b" " * 2_884_000, GRID, GRID)] == [400, 413, 200, 429]


def test_a_fault_is_answered_in_json(monkeypatch):
    with served("--planner", "joint_dbl", logged=["Exception in ASGI application\n"]) as client:
        monkeypatch.setattr(Planner, "plan", None)
        status, _, reply = client.plan(GRID)
        assert (status, reply) == (500, {"error": "the service failed; its log says more."})
        assert client.ask("GET", "/health")[0] == 200


def test_a_token_is_asked_for():
    with served("pretrained/r4", token=TOKEN) as client:
        for wrong in ({}, {"Authorization": f"Bearer {TOKEN}x"}, {"Authorization": f"Basic {TOKEN}"}):
            status, headers, reply = client.plan(GRID, **wrong)
            assert status == 401 and headers["WWW-Authenticate"] == "Bearer" and "token" in reply["error"]
            assert client.ask("GET", "/plans", **wrong)[0] == 401
        right = {"Authorization": f"Bearer {TOKEN}"}
        assert client.plan(GRID, **right)[0] == client.ask("GET", "/plans", **right)[0] == 200
        assert client.ask("GET", "/health")[0] == client.ask("GET", "/")[0] == 200


def test_too_many_plans_are_put_off():
    with served("--planner", "joint_dbl", "--rate", 3) as client:
        replies = [client.plan(GRID) for _ in range(4)]
        assert [status for status, *_ in replies] == [200, 200, 200, 429]
        wait = int(replies[-1][1]["Retry-After"])
        assert 10 <= wait <= 20 and f"after {wait} s" in replies[-1][2]["error"]
        assert client.ask("GET", "/health")[0] == 200


def test_the_rate_fills_up_evenly(monkeypatch):
    from pickplace.serve.service import Rate

    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    rate = Rate(60)
    assert [rate.take() for _ in range(60)] == [0.0] * 60 and rate.take() == pytest.approx(1)
    now[0] += 0.75
    assert rate.take() == pytest.approx(0.25)
    now[0] += 0.25
    assert rate.take() == 0.0 and rate.take() > 0
    now[0] += 3600
    assert [rate.take() for _ in range(61)].count(0.0) == 60


def test_health_answers_while_a_plan_is_computed(monkeypatch):
    """And plans are computed one after the other."""
    plan, events, healthy = Planner.plan, [], threading.Event()

    def slow(*given, **named):
        events.append("begin")
        assert healthy.wait(20)
        time.sleep(0.2)  # time for the other request
        events.append("end")
        return plan(*given, **named)

    with served("--planner", "joint_dbl") as client, ThreadPoolExecutor(2) as clients:
        monkeypatch.setattr(Planner, "plan", slow)
        replies = [clients.submit(client.plan, GRID) for _ in range(2)]
        wait_for(lambda: events)
        assert client.ask("GET", "/health")[0] == 200
        healthy.set()
        assert [reply.result()[0] for reply in replies] == [200, 200]
    assert events == ["begin", "end"] * 2


LOOKAHEAD = ("pretrained/r4", "--planner", "lookahead")


def test_a_deadline_ends_a_plan_and_its_wait():
    """A real search, which takes a second; the next plan is right."""
    with served(*LOOKAHEAD, "--rate", 1e6) as client, ThreadPoolExecutor(3) as clients:
        begun = time.monotonic()
        replies = [clients.submit(client.plan, {"id": n, **GRID, "deadline": 0.05}) for n in range(3)]
        for number, (status, _, reply) in enumerate(reply.result() for reply in replies):
            assert status == 504 and reply["id"] == number and "no plan within 0.05 s" in reply["error"]
        assert time.monotonic() - begun < 1
        status, _, reply = client.plan({**GRID, "deadline": 30})
        assert (status, reply["status"]) == (200, "ok")


def test_a_plan_ends_when_its_client_leaves(monkeypatch):
    begun, ended, plan = threading.Event(), [], Planner.plan

    def endless(*_, **__):
        begun.set()
        try:
            while True:
                pass
        finally:
            ended.append(time.monotonic())

    with served("--planner", "joint_dbl", "--deadline", 60) as client:
        monkeypatch.setattr(Planner, "plan", endless)
        body = json.dumps(GRID).encode()
        head = (
            f"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {len(body)}"
        )
        (one,) = open_sockets(client, 1, head.encode() + b"\r\n\r\n" + body)
        assert begun.wait(20)
        assert client.ask("GET", "/health")[0] == client.ask("GET", "/ready")[0] == 200  # while it computes
        one.close()
        wait_for(lambda: ended)
        monkeypatch.setattr(Planner, "plan", plan)
        assert client.plan(GRID)[0] == 200
        assert [each["status"] for each in client.ask("GET", "/plans")[2]["plans"]] == ["refused", "ok"]


def test_ready_says_whether_a_request_would_be_taken():
    head = b"POST /plan HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 99\r\n\r\n{"
    with served("--planner", "joint_dbl", "--rate", 1e6) as client:
        assert client.ask("GET", "/ready")[::2] == (200, {"status": "ready", "waiting": 0})
        sockets = open_sockets(client, 16, head)
        wait_for(lambda: client.ask("GET", "/ready")[0] == 503)
        status, headers, reply = client.ask("GET", "/ready")
        assert set(reply) == {"error"} and headers["Retry-After"] == "1"
        assert client.ask("GET", "/health")[0] == 200
        for one in sockets:
            one.close()
        wait_for(lambda: client.ask("GET", "/ready")[0] == 200)


def test_metrics_count_answers():
    from prometheus_client.parser import text_string_to_metric_families

    with served("--planner", "joint_dbl", token=TOKEN) as client:
        sent = {"Authorization": f"Bearer {TOKEN}"}
        for body in (GRID, GRID, b"{", {"tote_depth": [[5]]}, {**GRID, "tote_depth": [[0] * 6] * 6}):
            client.plan(body, **sent)
        assert client.plan(GRID)[0] == client.ask("GET", "/metrics")[0] == 401
        status, headers, text = client.ask("GET", "/metrics", **sent)
        families = {family.name: family for family in text_string_to_metric_families(text)}
    assert status == 200 and headers["Content-Type"].startswith("text/plain")
    counts = {
        (each.labels["http_status"], each.labels["plan_status"]): each.value
        for each in families["pickplace_answers"].samples
        if each.name.endswith("_total")
    }
    assert counts == {("200", "ok"): 2, ("200", "stuck"): 1, ("400", ""): 1, ("422", ""): 1, ("401", ""): 1}
    times = {each.name: each.value for each in families["pickplace_plan_seconds"].samples}
    assert times["pickplace_plan_seconds_count"] == 3 and times["pickplace_plan_seconds_sum"] > 0
    assert families["pickplace_waiting_requests"].samples[0].value == 0


def test_the_schema_says_units_and_frames(client):
    schemas = client.ask("GET", "/openapi.json")[2]["components"]["schemas"]
    for name in ("PlanRequest", "Plan", "Pose", "Alternative", "Box"):
        assert [key for key, entry in schemas[name]["properties"].items() if not entry.get("description")] == []
        assert "outer corner of cell (0, 0)" in schemas[name]["description"]
    assert "height units" in schemas["Pose"]["properties"]["center"]["description"]
    assert "; m" in schemas["PlanRequest"]["properties"]["accuracy"]["description"]


@pytest.mark.parametrize(
    ("arguments", "token", "message"),
    [
        (["--host", "0.0.0.0"], None, "--host=0.0.0.0: other machines can reach it; expected a token in the environ"),
        (["--host", "example.org"], None, "--host=example.org: other machines"),
        ([], "short", "PICKPLACE_TOKEN: got 5 characters; expected at least 16"),
        ([], "", "PICKPLACE_TOKEN: got 0 characters"),
        (["--port", "70000"], None, "--port=70000"),
        (["--rate", "0"], None, "--rate=0"),
        (["--history", "0"], None, "--history=0"),
        (["--deadline", "0"], None, "--deadline=0.0: expected seconds between 0.001 and 3600"),
        (["--log", "/proc/none/x"], None, "/proc/none/x: No such file or directory"),
        (["--support", "halves"], None, "--support=halves: "),
        (
            ["--gripper", "cup_array", "--effector-size", "3", "3"],
            None,
            "--gripper=cup_array --effector-size: got both",
        ),
        (["--host", "192.0.2.1"], TOKEN, "expected an address of this machine and a free port"),
    ],
)
def test_the_command_refuses_in_one_sentence(monkeypatch, capsys, arguments, token, message):
    monkeypatch.setattr(sys, "argv", ["pickplace-serve", "--planner", "joint_dbl", *arguments])
    monkeypatch.delenv(serve.TOKEN, raising=False)
    if token is not None:
        monkeypatch.setenv(serve.TOKEN, token)
    with pytest.raises(SystemExit, match="2"):
        serve.main()
    err = capsys.readouterr().err
    assert err.startswith("error: ") and err.count("\n") == 1 and message in err
    assert not token or token not in err


def test_a_bad_limit_on_the_memory_is_refused_at_the_start(monkeypatch, capsys):
    monkeypatch.setenv("PICKPLACE_MEMORY_GB", "abc")
    monkeypatch.setattr(sys, "argv", ["pickplace-serve", "--planner", "joint_dbl"])
    with pytest.raises(SystemExit, match="2"):
        serve.main()
    assert capsys.readouterr().err == "error: PICKPLACE_MEMORY_GB='abc': expected a number of gigabytes.\n"


def test_a_missing_extra_is_one_sentence(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["pickplace-serve", "pretrained/r4"])
    monkeypatch.delitem(sys.modules, "pickplace.serve.service", raising=False)
    monkeypatch.setitem(sys.modules, "fastapi", None)
    with pytest.raises(SystemExit, match="2"):
        serve.main()
    assert capsys.readouterr().err == "error: pickplace-serve: fastapi is missing; pip install 'pickplace[serve]'.\n"


# ---------------------------------------------------------------------- in a browser
EVIL = "<img src=x onerror='window.ran=1'><script>window.ran=1</script>"


def test_the_page_shows_new_plans_and_runs_nothing_of_a_request(browser):
    with served("pretrained/r4", "--history", 2) as client:
        browser.get(f"http://127.0.0.1:{client.port}/")
        browser.get_log("browser")  # empties it
        wait_until(browser, "document.getElementById('state').textContent.startsWith('No plan')")
        metres = {"items": [{"x": 0.1, "y": 0.125, "w": 0.08, "d": 0.04, "h": 0.05, "yaw": 20}], "cell_size": 0.05}
        depth = [[0.25 - 0.05 * (x < 10 and y < 5) for y in range(30)] for x in range(30)]
        _, _, plan = client.plan({"id": EVIL, **metres, "tote_depth": depth})
        wait_until(browser, "live.state().shown === 1 && live.state().at === 1")
        state = browser.execute_script("return live.state()")
        # At rest: the item's centre, from the pose of the plan and the way it hung from the gripper; lengths in cells.
        (px, py, _), (tx, ty, tz) = plan["pick"]["center"], plan["place"]["center"]
        turn = complex(0, 1) ** (plan["rotation_degrees"] / 90)
        middle = complex(tx, ty) + turn * (complex(0.1, 0.125) - complex(px, py))
        expected = [20 * middle.real, 20 * middle.imag, 20 * (plan["drop_height"] + 0.025)]
        for found in (state["item"][:3], state["target"]):
            assert found == pytest.approx(expected, abs=1e-3)
        assert state["gripper"] == pytest.approx([20 * tx, 20 * ty, 20 * tz], abs=1e-3)
        assert browser.find_element("id", "which").text.startswith('Plan 1, id "<img src=x')
        assert browser.find_element("id", "what").text.startswith("80 × 40 × 50 mm, turned")

        client.plan({"id": EVIL, "tote_depth": [[5]]})
        client.plan({**GRID, "tote_depth": [[0] * 6] * 6})
        wait_until(browser, "live.state().shown === 3")
        assert "The item fits nowhere any more" in browser.find_element("id", "ending").text
        buttons = browser.find_elements("css selector", "#plans button")
        assert [button.text.split()[-1] for button in buttons] == ["stuck", "refused"]  # the last two
        buttons[1].click()
        assert (
            browser.find_element("id", "ending").text == "bin_depth: missing; expected a depth map as a list of rows."
        )
        assert browser.execute_script("return window.ran") is None and errors(browser) == []
        hosts = browser.execute_script("return performance.getEntriesByType('resource').map(e => new URL(e.name).host)")
        assert set(hosts) == {f"127.0.0.1:{client.port}"}
        # Even what were written as HTML would not run.
        browser.execute_script(
            "const s = document.createElement('script'); s.text = 'window.ran = 1'; document.body.append(s)"
        )
        assert browser.execute_script("return window.ran") is None


def test_the_page_asks_for_the_token(browser):
    with served("pretrained/r4", token=TOKEN) as client:
        client.plan(GRID, Authorization=f"Bearer {TOKEN}")
        browser.get(f"http://127.0.0.1:{client.port}/")
        wait_until(browser, "!document.getElementById('sign').hidden")
        assert browser.execute_script("return live.state().plans") == 0
        browser.find_element("id", "token").send_keys(TOKEN)
        browser.find_element("css selector", "#sign button").click()
        wait_until(browser, "live.state().plans === 1 && document.getElementById('sign').hidden")


def test_a_page_without_webgl_says_so():
    """Its script stops at the renderer; run by node with a page of its own, as a browser would refuse it."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node")
    source = (ROOT / "pickplace/views/assets/scene.js").read_text()
    before = """
    const shown = [], document = {createElement: () => ({style: {}, setAttribute() {}})};
    const $ = id => ({prepend: part => shown.push(id + ": " + part.textContent)});
    const THREE = {WebGLRenderer: class { constructor() { throw new Error("Error creating WebGL context."); } }};
    const data = {bin: [5, 5, 1], tote: [6, 6], effector: [3, 3]};
    try { (() => {
    """
    after = "\n})(); } catch (error) { shown.push(error.message); }\nconsole.log(shown.join('|'));"
    run = subprocess.run([node, "-e", before + source + after], capture_output=True, text=True, check=True)
    words = "stage: This browser has no WebGL, so nothing can be shown in 3D. Switch on hardware acceleration"
    assert run.stdout.startswith(words) and run.stdout.endswith("|Error creating WebGL context.\n")
