"""A radio channel between robots: latency, loss, limited bandwidth, and a count of what was sent.

Time is what the caller says it is; nothing sleeps.
"""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import numpy as np

from ..matching.checks import check_count, check_interval
from ..matching.graph import ObjectGraph

Payload = TypeVar("Payload")

HEADER_BYTES = 32
"""Sender, receiver, time stamp, counts and a checksum."""
BYTES_PER_NUMBER = 4
"""Numbers travel as 32-bit floats."""


@dataclass(frozen=True)
class ChannelOptions:
    """What the channel does to messages.

    Attributes:
        latency_s: from sending to arrival. jitter_s: 1 sigma added to it, never making it negative.
        loss: probability that a message never arrives.
        bandwidth_bytes_s: shared by all senders; messages queue for it. None = unlimited.

    Raises:
        ValueError: a value out of its range.
    """

    latency_s: float = 0.0
    jitter_s: float = 0.0
    loss: float = 0.0
    bandwidth_bytes_s: float | None = None

    def __post_init__(self) -> None:
        check_interval("latency_s", self.latency_s, "[0, inf)")
        check_interval("jitter_s", self.jitter_s, "[0, inf)")
        check_interval("loss", self.loss, "[0, 1]")
        if self.bandwidth_bytes_s is not None:
            check_interval("bandwidth_bytes_s", self.bandwidth_bytes_s, "(0, inf]")


@dataclass(frozen=True)
class Message(Generic[Payload]):
    """A message as it arrives; its payload speaks of the time it was sent."""

    sender: str
    receiver: str
    payload: Payload
    sent_s: float
    received_s: float
    size_bytes: int


@dataclass(frozen=True)
class Traffic:
    """Totals since the channel was made: messages and bytes sent, messages lost and delivered."""

    sent: int = 0
    sent_bytes: int = 0
    lost: int = 0
    delivered: int = 0
    delivered_bytes: int = 0


class Channel(Generic[Payload]):
    """Messages in flight between robots. Messages may overtake each other when there is jitter."""

    def __init__(self, rng: np.random.Generator, options: ChannelOptions | None = None) -> None:
        self.options = options or ChannelOptions()
        self.traffic = Traffic()
        self._rng = rng
        self._flying: list[tuple[float, int, Message[Payload]]] = []
        self._order = itertools.count()
        self._free_at_s = -np.inf

    def send(self, sender: str, receiver: str, payload: Payload, *, time: float, size_bytes: int) -> None:
        """Put a message on the air at `time` s. Lost messages use bandwidth all the same.

        Raises:
            ValueError: a time that is not finite, or a negative size.
        """
        check_interval("time", time, "(-inf, inf)")
        check_count("size_bytes", size_bytes, 0)
        o, t = self.options, self.traffic
        lost = bool(self._rng.random() < o.loss)
        jitter = float(self._rng.normal()) * o.jitter_s
        leaves = time
        if o.bandwidth_bytes_s is not None:
            leaves = max(time, self._free_at_s) + size_bytes / o.bandwidth_bytes_s
            self._free_at_s = leaves
        arrives = leaves + max(0.0, o.latency_s + jitter)
        self.traffic = Traffic(t.sent + 1, t.sent_bytes + size_bytes, t.lost + lost, t.delivered, t.delivered_bytes)
        if not lost:
            message = Message(sender, receiver, payload, time, arrives, size_bytes)
            heapq.heappush(self._flying, (arrives, next(self._order), message))

    def receive(self, *, time: float) -> Iterator[Message[Payload]]:
        """All messages that have arrived by `time` s, in order of arrival; each is delivered once."""
        while self._flying and self._flying[0][0] <= time:
            message = heapq.heappop(self._flying)[2]
            t = self.traffic
            self.traffic = Traffic(
                t.sent, t.sent_bytes, t.lost, t.delivered + 1, t.delivered_bytes + message.size_bytes
            )
            yield message

    def clear(self) -> None:
        """Drop what is in flight; the totals stay."""
        self._flying.clear()
        self._free_at_s = -np.inf


def message_size(graph: ObjectGraph) -> int:
    """Bytes of a graph on the air: positions, covariances (6 numbers each) or variances, attributes, embeddings."""
    numbers: Any = graph.positions.size + graph.attributes.size + graph.attribute_variance.size
    numbers += 6 * len(graph) if graph.covariances is not None else len(graph)
    if graph.embedding is not None:
        numbers += graph.embedding.size
    return HEADER_BYTES + BYTES_PER_NUMBER * int(numbers)
