"""A node of ROS 2 over Zenoh, without a ROS installation, as rmw_zenoh's design describes it.

Everything that this package assumes about rmw_zenoh is in this file:

- A topic is the key ``DOMAIN/TOPIC/TYPE/HASH``, such as
  ``0/chatter/std_msgs::msg::dds_::String_/RIHS01_df66...``; the payload is CDR.
- Every message has an attachment: sequence number and time [ns] as int64, the number of bytes of the publisher's id
  (16) as one byte, and the id.
- Liveliness tokens show nodes, publishers and subscribers to tools such as ``ros2 topic list``:
  ``@ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NAME`` with the kind NN for a node; MP and MS, for a
  publisher and a subscriber, append ``/TOPIC/TYPE/HASH/QOS``. Slashes within a part become ``%``.
- The quality of service is ``RELIABILITY:DURABILITY:HISTORY,DEPTH:DEADLINE:LIFESPAN:LIVELINESS`` in the numbers of rmw,
  where a part that has its default (reliable, volatile, keep last, 42) is empty.
- Without a configuration, a session connects to a router on this computer at port 7447 and searches no network.
"""

from __future__ import annotations

import hashlib
import os
import struct
import threading
import time
import warnings
from collections.abc import Callable
from typing import Any

from ..errors import OptionError
from ..system.extras import require
from ..system.lanes import returns
from .graph import PUBLISHED_DEPTH, RECEIVED_DEPTH, full_name
from .messages import RosMessages

ROUTER = "tcp/localhost:7447"
"""Where rmw_zenoh's router listens."""
CONFIG_VARIABLE = "ZENOH_SESSION_CONFIG_URI"
_PATIENCE = "transport/link/tx/queue/congestion_control/drop"
_PUBLISHED, _RECEIVED = f"::,{PUBLISHED_DEPTH}:,:,:,,", f"2::,{RECEIVED_DEPTH}:,:,:,,"  # qualities of service
_CLOSING_S = 5.0
_ATTACHMENT = struct.Struct("<qqB16s")


def type_key(name: str) -> str:
    """``"std_msgs/msg/String"`` as rmw_zenoh writes it: ``"std_msgs::msg::dds_::String_"``."""
    package, kind, plain = name.split("/")
    return f"{package}::{kind}::dds_::{plain}_"


def attachment(number: int, stamp_ns: int, publisher_id: bytes) -> bytes:
    """The 33 bytes with each message: its number from 1, the time of publishing, and the id of its publisher."""
    return _ATTACHMENT.pack(number, stamp_ns, len(publisher_id), publisher_id)


class ZenohGraph:
    """A node over Zenoh; see `Graph`. By default, its ROS_DOMAIN_ID is that of the environment, or 0.

    connect : zenoh endpoint of a router or a peer. By default the session is configured by the file that the variable
        ZENOH_SESSION_CONFIG_URI names or, without it, connects to `ROUTER`.
    messages : for the hashes of types.
    """

    def __init__(
        self,
        name: str = "edgeperc",
        *,
        namespace: str = "/",
        domain: int | None = None,
        connect: str | None = None,
        messages: RosMessages | None = None,
    ) -> None:
        self._zenoh = require("zenoh", "ros2", "A ROS 2 node over Zenoh", package="eclipse-zenoh")
        self._messages = messages or RosMessages()
        self._namespace = namespace if namespace == "/" else full_name(namespace)
        self.name = full_name(name, self._namespace)
        self._domain = _domain(domain)
        self._closing = threading.Lock()
        try:
            self._session = self._zenoh.open(self._config(connect))
        except Exception as exc:  # ZError, and others for a file that is not JSON
            raise OptionError(
                f"no Zenoh session with connect={connect!r} and {CONFIG_VARIABLE}="
                f"{os.environ.get(CONFIG_VARIABLE)!r} ({' '.join(str(exc).split())}); expected an endpoint such as "
                f"{ROUTER}, or the path of a JSON5 file"
            ) from exc
        self._router = connect or os.environ.get(CONFIG_VARIABLE) or ROUTER
        self._n_entities = 0
        self._kept: list[Any] = []  # a token lives as long as its object
        self._declare("NN")

    def _config(self, connect: str | None) -> Any:
        file = os.environ.get(CONFIG_VARIABLE)
        if connect is None and file:
            return self._zenoh.Config.from_file(file)
        config = self._zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("connect/endpoints", f'["{connect or ROUTER}"]')
        config.insert_json5("listen/endpoints", '["tcp/localhost:0"]')
        config.insert_json5("scouting/multicast/enabled", "false")
        # Zenoh drops a message after 1 ms without room for its first packet, and after 50 ms within it. A cloud has
        # 2 MB, and one message follows another. [us]
        config.insert_json5(_PATIENCE, '{"wait_before_drop": 50000, "max_wait_before_drop_fragments": 500000}')
        return config

    def _declare(self, kind: str, *more: str) -> str:
        """Show an entity to other nodes. Returns the key of its token."""
        above, _, plain = self.name.rpartition("/")
        name = [str(self._n_entities), kind, "%", _mangled(above or "/"), plain]
        self._n_entities += 1
        key = "/".join(["@ros2_lv", str(self._domain), str(self._session.zid()), "0", *name, *more])
        self._kept.append(self._session.liveliness().declare_token(key))
        return key

    def parameter(self, name: str, default: Any) -> Any:
        """The default: this node offers no services, so no parameters either."""
        return default

    def manage(self, change: Callable[[str], object]) -> bool:
        """No: this node offers no services, so no lifecycle manager reaches it."""
        return False

    def advertise(self, topic: str, message_type: str) -> _ZenohOutput:
        """Begin to publish; see `Graph.advertise`."""
        full, kind, digest = self._topic(topic, message_type)
        publisher = self._session.declare_publisher(
            f"{self._domain}{full}/{kind}/{digest}", congestion_control=self._zenoh.CongestionControl.DROP
        )
        token = self._declare("MP", _mangled(full), kind, digest, _PUBLISHED)
        return _ZenohOutput(publisher, hashlib.sha256(token.encode()).digest()[:16])

    def subscribe(self, topic: str, message_type: str, receive: Callable[[bytes], None]) -> None:
        """Receive messages; see `Graph.subscribe`. Warns if there is nobody yet to receive them from."""
        if not [*self._session.info.routers_zid(), *self._session.info.peers_zid()]:
            warnings.warn(
                f"no router and no peer answers yet ({self._router}), so no message can come; the node goes on trying. "
                "Start the router, ros2 run rmw_zenoh_cpp rmw_zenohd; or pass connect= (on the command line "
                "--connect).",
                stacklevel=1,  # of several subscriptions, the same
            )
        full, kind, digest = self._topic(topic, message_type)
        # Any hash: Humble writes none, and what the bytes are is checked when they are read.
        key = f"{self._domain}{full}/{kind}/*"
        self._kept.append(self._session.declare_subscriber(key, lambda sample: receive(sample.payload.to_bytes())))
        self._declare("MS", _mangled(full), kind, digest, _RECEIVED)

    def _topic(self, topic: str, message_type: str) -> tuple[str, str, str]:
        return full_name(topic, self._namespace), type_key(message_type), self._messages.type_hash(message_type)

    def close(self) -> None:
        """Undeclare everything and close the session; more calls have no effect."""
        with self._closing:
            entities, self._kept = self._kept, []
            returns(lambda: self._undeclare(entities), _CLOSING_S, "the Zenoh session did not close")

    def _undeclare(self, kept: list[Any]) -> None:
        for each in reversed(kept):
            each.undeclare()
        if kept:
            self._session.close()


class _ZenohOutput:
    def __init__(self, publisher: Any, publisher_id: bytes) -> None:
        self._publisher, self._id = publisher, publisher_id
        self._n = 0

    @property
    def is_wanted(self) -> bool:
        return bool(self._publisher.matching_status.matching)

    def publish(self, data: bytes) -> None:
        self._n += 1
        self._publisher.put(data, attachment=attachment(self._n, time.time_ns(), self._id))


def _domain(given: int | None) -> int:
    text = os.environ.get("ROS_DOMAIN_ID") or "0"
    if given is None and not text.isdecimal():
        raise OptionError(f"ROS_DOMAIN_ID is {text!r}; expected a whole number")
    domain = int(text) if given is None else given
    if not 0 <= domain <= 232:
        raise OptionError(f"the domain is {domain}; expected 0 to 232")
    return domain


def _mangled(name: str) -> str:
    return name.replace("/", "%")
