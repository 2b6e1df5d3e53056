"""The newest payloads of a topic, for any number of readers, none of whom holds up the others or the network."""

from __future__ import annotations

import threading
import time
from typing import Any, Generic, Optional, TypeVar

from .codec import Rejected, decode

M = TypeVar("M")

# Silence in seconds after which a round is taken that is older than the last: the cell has begun anew.
FORGET_S = 3.0

# Nodes whose statuses are kept; a further node replaces the node with the oldest status.
MAX_NODES = 1024


class Stream(Generic[M]):
    """One kind of payload. Rounds replace each other; statuses do so for each node."""

    def __init__(self, kind: type[M], topic: str, is_retained: bool = False, has_rounds: bool = True) -> None:
        self.kind, self.topic, self.is_retained, self.has_rounds = kind, topic, is_retained, has_rounds
        self.number = 0
        self.told: set[str] = set()
        self._newest: dict[str, tuple[int, M]] = {}
        self._last = (-1, "", -1)
        self._last_at = 0.0

    def take(self, node: str, payload: bytes, changed: threading.Condition) -> None:
        """Takes a payload, or raises `Rejected`; `node` is the last level of a status's topic."""
        message: Any = decode(self.kind, payload) if payload else None
        if message is not None and node and message.node != node:
            raise Rejected("node_mismatch", f"a status of {message.node!r}")
        if message is not None and self.has_rounds:
            self._check_order((message.epoch, message.aggregator or "", message.round))
        with changed:
            self._newest.pop(node, None)
            # An empty payload withdraws a status.
            if message is not None:
                if len(self._newest) >= MAX_NODES:
                    self._newest.pop(next(iter(self._newest)))
                self.number += 1
                self._newest[node] = (self.number, message)
                changed.notify_all()

    def after(self, number: int) -> Optional[tuple[int, M]]:
        """The earliest of the newest payloads that came after the numbered one."""
        return min((entry for entry in self._newest.values() if entry[0] > number), key=lambda entry: entry[0], default=None)

    def _check_order(self, this: tuple[int, str, int]) -> None:
        """Rejects what is not later by epoch, aggregator and round, in this order."""
        now = time.monotonic()
        if this <= self._last and now - self._last_at < FORGET_S:
            reason = "superseded" if this[:2] < self._last[:2] else "repeated"
            (epoch, _, round), (last_epoch, _, last_round) = this, self._last
            raise Rejected(reason, f"epoch {epoch} round {round} after epoch {last_epoch} round {last_round}")
        self._last, self._last_at = this, now
