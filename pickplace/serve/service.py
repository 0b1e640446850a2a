"""The HTTP service around a planner: ``/plan``, ``/health``, and a page that shows the last plans."""

import asyncio
import hmac
import json
import math
import re
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from threading import Lock

import anyio
from fastapi import Depends, FastAPI, Request
from fastapi.exceptions import HTTPException, RequestValidationError
from fastapi.responses import HTMLResponse, JSONResponse, Response
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from pydantic import BaseModel, Field
from starlette.exceptions import HTTPException as StarletteHTTPException
from starlette.requests import ClientDisconnect

import pickplace
from pickplace.common.validate import excerpt
from pickplace.config.registry import node_of
from pickplace.policies.restore import cell_settings
from pickplace.robot.planner import Plan, Planner
from pickplace.serve import live
from pickplace.serve.deadline import Deadline
from pickplace.serve.decisions import DecisionLog
from pickplace.serve.metrics import Metrics
from pickplace.serve.request import Answer, PlanRequest, RequestLimits, read_request, solve
from pickplace.serve.schema import request_schema, with_comments

MAX_WAITING = 16  # greatest number of requests whose body is read, or that wait for their turn
BODY_SECONDS = 30  # time that a client has to send its request


class Refusal(BaseModel):
    """The reason for which a request has no plan, in one sentence."""

    error: str
    empty_bin: bool = Field(False, description="Nothing lies in the bin: wait for items.")
    id: object = None


class Health(BaseModel):
    """The version of the service, its planner and its cell."""

    status: str
    version: str
    planner: str
    checkpoint: str | None
    cell: dict


class Ready(BaseModel):
    """Confirmation that the service takes requests, and the number of requests that it has yet to answer."""

    status: str
    waiting: int


class Rate:
    """A budget of plans, which fills up evenly.

    A request whose body is refused costs a plan, too: otherwise a client could send bad ones without end.

    Args:
        per_minute: greatest number of plans a minute; all of them may come at once.
    """

    def __init__(self, per_minute: float):
        self.seconds = 60 / per_minute  # of a plan
        self.full_at = 0.0  # the time at which the budget is full again

    def take(self) -> float:
        """Take one plan and return 0; if the budget is empty, return the seconds until the next plan."""
        now = time.monotonic()
        full_at = max(now, self.full_at) + self.seconds
        if (wait := full_at - now - 60) > 1e-6:
            return wait
        self.full_at = full_at
        return 0.0


class Service:
    """The planner, which serves one request at a time in a thread of its own, and the last answers.

    Args:
        planner, defaults: as :func:`pickplace.serve.options.load_planner` returns them.
        history: number of answers that are kept.
        log: log of all answers; None: no log.
    """

    def __init__(self, planner: Planner, defaults: dict, history: int, log: DecisionLog | None):
        self.planner, self.defaults, self.log = planner, defaults, log
        self.limits, self.metrics = RequestLimits.of(planner.cell), Metrics()
        self.worker = ThreadPoolExecutor(1, "planner")
        self.waiting = self.count = 0
        self.lock = Lock()
        self.history: deque[dict] = deque(maxlen=history)

    async def answer(self, body: bytes, wait_for_client: Callable[[], Awaitable]) -> Answer:
        """Return the answer to a request. ``wait_for_client`` ends when the client leaves, which cancels the plan.

        Bodies are parsed in other threads than plans are computed in, so that a deadline includes the waiting.
        """
        status, reply, request = await asyncio.to_thread(read_request, body, self.limits, self.defaults)
        if request is None:
            self.note(None, found := Answer(status, reply, json.dumps(reply)), 0.0)
            return found
        deadline, loop = Deadline(request.deadline), asyncio.get_running_loop()
        work = loop.run_in_executor(self.worker, self.plan, request, reply, deadline)
        gone = asyncio.ensure_future(wait_for_client())
        try:
            await asyncio.wait({work, gone}, return_when=asyncio.FIRST_COMPLETED)
            if not work.done():
                deadline.cancel()
            return await work
        finally:
            gone.cancel()

    def plan(self, request: PlanRequest, reply: dict, deadline: Deadline) -> Answer:
        """Return the answer to a request that was read without error; only the worker calls this."""
        start = time.perf_counter()
        found = solve(self.planner, request, reply, deadline)
        seconds = time.perf_counter() - start
        self.metrics.time(seconds)
        self.note(request, found, seconds)
        return found

    def note(self, request: PlanRequest | None, found: Answer, seconds: float) -> None:
        """Record an answer for the page, the metrics and the log."""
        entry = live.entry(self.planner.cell, 0, request, found.reply, seconds)
        with self.lock:  # two threads may call this
            if self.log is not None:  # first: a plan that cannot be logged is not returned
                self.log.add(request, found.reply, seconds)
            self.metrics.count(found.status, found.reply.get("status", ""))
            self.history.append({**entry, "number": self.count + 1})
            self.count += 1  # last, so that each number that a reader sees has its answer


async def read_body(request: Request, most: int) -> bytes:
    """Return the body of a request.

    Raises:
        HTTPException: 413 for more than ``most`` bytes, 408 for a client that is too slow, 400 for a client that
            leaves.
    """
    body = bytearray()
    try:
        with anyio.fail_after(BODY_SECONDS):
            async for chunk in request.stream():
                body += chunk
                if len(body) > most:
                    raise HTTPException(413, f"the body has more than {most:,} bytes; expected a shorter one.")
    except TimeoutError as error:
        raise HTTPException(408, f"the body took more than {BODY_SECONDS} s; expected a faster one.") from error
    except ClientDisconnect as error:  # nobody reads this answer, but it must not count as 500
        raise HTTPException(400, "the connection ended within the body; expected a whole one.") from error
    return bytes(body)


def make_app(
    planner: Planner,
    defaults: dict,
    name: str = "policy",
    checkpoint: str | None = None,
    token: str | None = None,
    rate: float = 600,
    history: int = 20,
    hosts: Sequence[str] = ("localhost", "127.0.0.1", "[::1]"),
    log: DecisionLog | None = None,
) -> FastAPI:
    """Return the service as an ASGI application.

    Args:
        planner, defaults: as :func:`pickplace.serve.options.load_planner` returns them.
        name, checkpoint: names of the planner and its checkpoint, for ``/health``.
        token: sent by clients as ``Authorization: Bearer <token>``; None: not needed.
        rate: greatest number of plans a minute.
        history: number of answers that the page shows.
        hosts: names by which clients may call the service; ``"*"``: any.
        log: log to which all answers are appended; None: no log.
    """
    service, budget = Service(planner, defaults, history, log), Rate(rate)
    reach = node_of("env.reach", planner.cell.reach)
    health = Health(
        status="ok", version=pickplace.__version__, planner=name, checkpoint=checkpoint,
        cell=cell_settings(planner.cell) | {"reach": "everywhere" if reach is None else reach["_target_"]},
    )  # fmt: skip
    page = live.page(planner.cell)
    page_headers = {
        "Content-Security-Policy": live.content_policy(page), "X-Content-Type-Options": "nosniff",
        "Referrer-Policy": "no-referrer", "Cache-Control": "no-store",
    }  # fmt: skip

    @asynccontextmanager
    async def lifespan(_):
        yield
        service.waiting = MAX_WAITING  # not ready any more
        service.worker.shutdown(wait=False, cancel_futures=True)

    async def check_host(request: Request) -> None:
        # Starlette's TrustedHostMiddleware would answer in plain text.
        host = request.headers.get("host", "")
        if "*" not in hosts and re.sub(r":\d*$", "", host).lower() not in map(str.lower, hosts):
            raise HTTPException(400, f"Host: got {excerpt(host)}; expected a name of this service, see --allow-host.")

    async def refuse(request: Request, error: Exception):
        status, text, headers = 500, "the service failed; its log says more.", None
        if isinstance(error, StarletteHTTPException):
            status, text, headers = error.status_code, error.detail, error.headers
        elif isinstance(error, RequestValidationError):
            status, text = 422, "{}: {msg}.".format(".".join(map(str, error.errors()[0]["loc"])), **error.errors()[0])
        if request.url.path == "/plan":
            service.metrics.count(status)
        return JSONResponse({"error": text}, status, headers)

    app = FastAPI(
        title="pickplace", version=pickplace.__version__, lifespan=lifespan, docs_url=None, redoc_url=None,
        dependencies=[Depends(check_host)],
        description="Where a suction robot picks an item in a bin, and where and how it places it in a tote.",
        exception_handlers=dict.fromkeys((Exception, StarletteHTTPException, RequestValidationError), refuse),
    )  # fmt: skip

    def authorize(sent: HTTPAuthorizationCredentials | None = Depends(HTTPBearer(auto_error=False))) -> None:  # noqa: B008
        given = "" if sent is None else sent.credentials
        if token is not None and not hmac.compare_digest(given.encode(), token.encode()):
            detail = "the token is missing or wrong; expected Authorization: Bearer <token>."
            raise HTTPException(401, detail, {"WWW-Authenticate": "Bearer"})

    refusals = {
        400: "No JSON object, or a wrong Host", 401: "No token, or a wrong one", 408: "The body came too slowly",
        413: "The body is too long", 415: "Not application/json", 422: "Maps or settings that cannot be used",
        429: "Too many plans; Retry-After says when to come back", 500: "The service failed; its log says more",
        503: "Too many connections; Retry-After says when to come back",
        504: "No plan within the deadline",
    }  # fmt: skip
    answers: dict = {
        200: {"description": "A plan; status says whether there is one", "model": Plan},
        **{code: {"description": text, "model": Refusal} for code, text in refusals.items()},
    }

    @app.post("/plan", responses=answers, dependencies=[Depends(authorize)], response_class=Response)
    async def plan(request: Request):
        """Plan one pick and one place. The body is a line of ``pickplace-plan``, and so is the answer."""
        if request.headers.get("content-type", "").partition(";")[0].strip().lower() != "application/json":
            # A foreign page can send forms and plain text without permission, but no JSON.
            raise HTTPException(415, "Content-Type: expected application/json.")
        if seconds := math.ceil(1 if service.waiting >= MAX_WAITING else budget.take()):
            detail = f"too many plans are asked for; expected the next request after {seconds} s."
            raise HTTPException(429, detail, {"Retry-After": str(seconds)})
        service.waiting += 1  # before reading: a slow body takes up a place, too
        try:
            service.metrics.waiting.set(service.waiting)
            body = await read_body(request, service.limits.size)
            found = await service.answer(body, request.receive)
        finally:
            service.waiting -= 1
            service.metrics.waiting.set(service.waiting)
        return Response(found.text, found.status, media_type="application/json")

    @app.get("/health")
    async def get_health() -> Health:
        """Return the version, the planner and the cell, also while a plan is computed; needs no token."""
        return health

    @app.get("/ready", responses={503: {"description": "The queue is full", "model": Refusal}})
    async def get_ready() -> Ready:
        """Say whether a request would be taken now, for a load balancer; needs no token."""
        if service.waiting >= MAX_WAITING:
            raise HTTPException(503, "too many requests wait; expected the next one after 1 s.", {"Retry-After": "1"})
        return Ready(status="ready", waiting=service.waiting)

    @app.get("/metrics", dependencies=[Depends(authorize)], response_class=Response)
    async def get_metrics():
        """Return metrics for Prometheus: answers by status, times, and waiting requests."""
        return Response(service.metrics.text(), media_type=service.metrics.content_type)

    @app.get("/plans", dependencies=[Depends(authorize)])
    async def plans(after: int = 0) -> dict:
        """Return the last answers with a number above ``after``, for the page; lengths are in cells."""
        news = [entry for entry in list(service.history) if entry["number"] > after]
        return {"last": news[-1]["number"] if news else service.count, "most": history, "plans": news}

    @app.get("/", response_class=HTMLResponse)
    async def show():
        """Return the page. It loads its plans from ``/plans``, and needs no token itself."""
        return HTMLResponse(page, headers=page_headers)

    # FastAPI does not know the schema of requests, as it does not parse them.
    described = app.openapi()
    schemas = described["components"]["schemas"]
    schemas |= request_schema()
    with_comments(schemas)
    described["paths"]["/plan"]["post"]["requestBody"] = {
        "required": True,
        "content": {"application/json": {"schema": {"$ref": "#/components/schemas/PlanRequest"}}},
    }
    return app
