"""Limit the number of connections of ``pickplace-serve``, and the time that each may wait for its client."""

from fastapi.responses import JSONResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 32  # greatest number at a time; each may hold one request in memory
CLIENT_SECONDS = 10  # time that a client has to send the headers of a request, or to read an answer
CHECKS = 10  # number of checks in that time

BUSY_RESPONSE = JSONResponse(
    {"error": f"more than {CONNECTIONS} requests are open; expected the next one after 1 s."},
    503,
    {"Retry-After": "1", "Connection": "close"},
)

AMBIGUOUS_LENGTH_RESPONSE = JSONResponse(
    {"error": "Content-Length and Transfer-Encoding: got both, expected one: they may disagree where the body ends."},
    400,
    {"Connection": "close"},
)


class Connection(H11Protocol):
    """One connection, which ends if its client takes too long: uvicorn alone waits for headers without end.

    With more than :data:`CONNECTIONS`, the service ends the connection whose client has kept it waiting the longest, so
    that idle ones keep nobody out. If it has yet to answer all of them, the new one gets the answer 503, in JSON;
    uvicorn's own limit answers in plain text. The time for a body is limited where it is read. A plan has its deadline.
    """

    def connection_made(self, transport) -> None:
        super().connection_made(transport)
        transport.set_write_buffer_limits(0)  # pause writing as soon as the client reads too slowly
        self.app = _refuse_ambiguous(self.config.loaded_app)
        self.since = self.loop.time()  # when the connection was made, or its last answer written
        if len(self.connections) > CONNECTIONS:
            idle = [each for each in self.connections if each is not self and each.is_waiting_for_client]
            if idle:
                min(idle, key=lambda each: each.since).end()
            else:
                self.app = BUSY_RESPONSE
        self._check(None, 0)

    @property
    def is_waiting_for_client(self) -> bool:
        """Whether the service waits for the client: to send a request, or to read an answer."""
        return self.cycle is None or self.cycle.response_complete or self.flow.write_paused

    def on_response_complete(self) -> None:
        self.since = self.loop.time()
        super().on_response_complete()

    def end(self) -> None:
        """End the connection now."""
        self.connections.discard(self)
        self.transport.abort()

    def _check(self, last_cycle, waits: int) -> None:
        """End the connection if it waited for its client at each of the last checks, with no request between them."""
        waits = waits + 1 if self.is_waiting_for_client and self.cycle is last_cycle else 0
        if waits > CHECKS:
            self.end()
        elif self in self.connections:
            self.loop.call_later(CLIENT_SECONDS / CHECKS, self._check, self.cycle, waits)


def _refuse_ambiguous(app):
    """Return an application that refuses requests with two lengths, which a proxy may read as two requests."""

    async def checked(scope, receive, send):
        keys = {key for key, _ in scope.get("headers", ())}
        is_ambiguous = {b"content-length", b"transfer-encoding"} <= keys
        await (AMBIGUOUS_LENGTH_RESPONSE if is_ambiguous else app)(scope, receive, send)

    return checked
