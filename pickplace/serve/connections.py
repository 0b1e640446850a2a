"""Connections of ``pickplace-serve``: there are not too many, and none waits long for its client."""

import asyncio

from fastapi.responses import JSONResponse
from uvicorn.protocols.http.h11_impl import H11Protocol

CONNECTIONS = 32  # at a time; each may hold one request in memory
CLIENT_SECONDS = 10  # time that a client has to send the headers of a request, or to read an answer

CROWDED = JSONResponse(
    {"error": f"more than {CONNECTIONS} connections are open; expected the next request after 1 s."},
    503,
    {"Retry-After": "1", "Connection": "close"},
)


class Connection(H11Protocol):
    """One connection, which ends where its client takes too long: uvicorn alone waits for headers without end.

    Connections above :data:`CONNECTIONS` get the answer 503. The time that a client has for a body is limited where
    the body is read, and a plan may take as long as it needs.
    """

    deadline: asyncio.TimerHandle | None = None

    def connection_made(self, transport) -> None:
        super().connection_made(transport)
        transport.set_write_buffer_limits(0)  # so that writing pauses as soon as the client reads too slowly
        if len(self.connections) > CONNECTIONS:
            self.app = CROWDED
        self._watch()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._watch()

    def pause_writing(self) -> None:
        super().pause_writing()
        self._watch()

    def resume_writing(self) -> None:
        super().resume_writing()
        self._watch()

    def connection_lost(self, exc: Exception | None) -> None:
        self._end_watch()
        super().connection_lost(exc)

    def _watch(self) -> None:
        """Begin to count the client's time where the next move is its own, or end it where it is not."""
        lacks_request = self.cycle is None or self.cycle.response_complete
        if not (lacks_request or self.flow.write_paused):
            self._end_watch()
        elif self.deadline is None:
            self.deadline = self.loop.call_later(CLIENT_SECONDS, self.transport.abort)

    def _end_watch(self) -> None:
        if self.deadline is not None:
            self.deadline.cancel()
            self.deadline = None
