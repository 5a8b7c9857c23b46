"""What a node needs of its middleware: names, and topics of CDR bytes."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Any, Literal, Protocol

from ..errors import OptionError

PUBLISHED_DEPTH, RECEIVED_DEPTH = 10, 5
"""Messages that are kept of a topic. What is published is reliable, as by ROS 2's default profile: subscribers of
sensor data receive it, too, and those of RViz nothing else. What is received is sensor data, best effort: from reliable
publishers, too. Both are volatile.
"""

State = Literal["unconfigured", "inactive", "active", "finalized"]
"""Primary states of a managed node."""
TRANSITIONS: Mapping[str, tuple[tuple[State, ...], State]] = {
    "configure": (("unconfigured",), "inactive"),
    "activate": (("inactive",), "active"),
    "deactivate": (("active",), "inactive"),
    "cleanup": (("inactive",), "unconfigured"),
    "shutdown": (("unconfigured", "inactive", "active"), "finalized"),
}
"""From which states each transition leads, and where to."""


class Output(Protocol):
    """A topic to publish on."""

    @property
    def is_wanted(self) -> bool:
        """Whether there is a subscriber."""

    def publish(self, data: bytes) -> None:
        """Publish the CDR bytes of a message."""


class Graph(Protocol):
    """A node in a ROS graph; one for each middleware."""

    name: str  # fully qualified name of the node

    def parameter(self, name: str, default: Any) -> Any:
        """Declare a parameter that does not change later. Returns its value: the default, unless the user set it."""

    def advertise(self, topic: str, message_type: str) -> Output:
        """Begin to publish on a topic, reliably."""

    def subscribe(self, topic: str, message_type: str, receive: Callable[[bytes], None]) -> None:
        """Call ``receive`` with the CDR bytes of each message, in a thread of the middleware, as sensor data."""

    def manage(self, change: Callable[[str], object]) -> bool:
        """Let lifecycle managers call ``change`` with the name of a transition, in a thread of the middleware.

        Returns whether they can: whether the graph has services, and was made for a managed node.
        """

    def close(self) -> None:
        """Leave the graph."""


def full_name(name: str, namespace: str = "/") -> str:
    """The absolute name of a topic or a node: of ``"/points"``, itself; others are relative to the namespace."""
    full = name if name.startswith("/") else f"{namespace.rstrip('/')}/{name}"
    full = full if full.startswith("/") else f"/{full}"
    if not re.fullmatch(r"(/[A-Za-z_][A-Za-z0-9_]*)+", full) or "__" in full:
        raise OptionError(
            f"{full!r} is not a name of ROS 2; expected words of letters, digits and single underscores after slashes, "
            "such as /lidar_top/points"
        )
    return full
