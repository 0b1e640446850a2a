"""Metrics of a service for Prometheus: the number of answers of each kind, and the time that they took."""

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_LATEST

#: Upper ends of the intervals of an answer's time, in seconds.
SECONDS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 30)


class Metrics:
    """Counters of one service; none is shared with other services of the process.

    Attributes:
        content_type: of :meth:`text`.
    """

    content_type = CONTENT_TYPE_LATEST

    def __init__(self) -> None:
        self._registry = CollectorRegistry()
        self._answers = Counter(
            "pickplace_answers", "Answers to POST /plan, by HTTP status and status of the plan, empty without one",
            ["http_status", "plan_status"], registry=self._registry,
        )  # fmt: skip
        self._seconds = Histogram(
            "pickplace_plan_seconds", "Time from the turn of a request to its answer, waiting excluded",
            buckets=SECONDS, registry=self._registry,
        )  # fmt: skip
        self.waiting = Gauge(
            "pickplace_waiting_requests", "Requests whose body is read, or that wait for their turn",
            registry=self._registry,
        )  # fmt: skip

    def count(self, http_status: int, plan_status: str = "") -> None:
        """Count an answer."""
        self._answers.labels(str(http_status), plan_status).inc()

    def time(self, seconds: float) -> None:
        """Record the time that a plan took."""
        self._seconds.observe(seconds)

    def text(self) -> bytes:
        """Return the metrics in the format of Prometheus."""
        return generate_latest(self._registry)
