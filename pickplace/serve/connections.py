"""Connections of ``pickplace-serve``: their number is limited, and so is the time that each waits for its client."""

from fastapi.responses import JSONResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 32  # at a time; each may hold one request in memory
CLIENT_SECONDS = 10  # time that a client has to send the headers of a request, or to read an answer
CHECKS = 10  # in that time

CROWDED = JSONResponse(
    {"error": f"more than {CONNECTIONS} connections are open; expected the next request after 1 s."},
    503,
    {"Retry-After": "1", "Connection": "close"},
)


class Connection(H11Protocol):
    """One connection, which ends where its client takes too long: uvicorn alone waits for headers without end.

    Connections above :data:`CONNECTIONS` get the answer 503, in JSON: that of uvicorn's own limit is plain text. The
    time that a client has for a body is limited where the body is read, and a plan may take as long as it needs.
    """

    def connection_made(self, transport) -> None:
        super().connection_made(transport)
        transport.set_write_buffer_limits(0)  # so that writing pauses as soon as the client reads too slowly
        if len(self.connections) > CONNECTIONS:
            self.app = CROWDED
        self._check(None, 0)

    def _check(self, last_cycle, waits: int) -> None:
        """End the connection if it was the client's move at each of the last checks, with no request between them."""
        is_clients_move = self.cycle is None or self.cycle.response_complete or self.flow.write_paused
        waits = waits + 1 if is_clients_move and self.cycle is last_cycle else 0
        if waits > CHECKS:
            self.transport.abort()
        elif self in self.connections:
            self.loop.call_later(CLIENT_SECONDS / CHECKS, self._check, self.cycle, waits)
