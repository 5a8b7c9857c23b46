"""A node of ROS 2 by rclpy, where ROS is installed. Messages stay CDR bytes, as over Zenoh."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Any

from ..errors import OptionError
from .graph import PUBLISHED_DEPTH, RECEIVED_DEPTH, TRANSITIONS


class RclpyGraph:
    """A node by rclpy; see `Graph`. By default, its ROS_DOMAIN_ID is that of the environment.

    ros_args : what follows ``--ros-args``: remappings (``-r points:=/os/points``), parameters (``-p sensor:=os1-64``)
        and files of parameters.
    managed : whether it is a lifecycle node: `manage` says what its transitions do.
    """

    def __init__(
        self,
        name: str = "edgeperc",
        *,
        namespace: str = "/",
        domain: int | None = None,
        ros_args: Sequence[str] = (),
        managed: bool = False,
    ) -> None:
        try:
            self._rclpy: Any = import_module("rclpy")
            executors, self._qos, signals = (import_module(f"rclpy.{part}") for part in ("executors", "qos", "signals"))
        except ImportError as exc:
            raise OptionError(
                f"rclpy cannot be imported ({exc}); run 'source /opt/ros/DISTRIBUTION/setup.bash' first, or leave out "
                "--rclpy: the node over Zenoh needs no ROS installation"
            ) from exc
        self._context = self._rclpy.Context()
        given = ["edgeperc", "--ros-args", *ros_args] if ros_args else ["edgeperc"]
        try:
            # Signals stay with the program: rclpy would end its waiting without an error.
            self._rclpy.init(
                args=given,
                context=self._context,
                domain_id=domain,
                signal_handler_options=signals.SignalHandlerOptions.NO,
            )
            self._change: Callable[[str], object] | None = None
            make = self._managed_node() if managed else self._rclpy.create_node
            self._managed = managed
            self._node = make(name, context=self._context, namespace=namespace)
        except Exception as exc:
            raise OptionError(f"rclpy does not take name={name!r} with --ros-args {' '.join(ros_args)}: {exc}") from exc
        self.name = str(self._node.get_fully_qualified_name())
        self._executor = executors.SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._thread = threading.Thread(target=self._executor.spin, name="edgeperc-rclpy", daemon=True)

    def _managed_node(self) -> Any:
        """A class of lifecycle nodes. Its methods are taken when a node is made, so they are looked up here later."""
        lifecycle: Any = import_module("rclpy.lifecycle")
        results = lifecycle.TransitionCallbackReturn

        def callback(transition: str) -> Callable[[Any, Any], Any]:
            def on_transition(node: Any, _state: Any) -> Any:
                try:
                    if self._change is not None:
                        self._change(transition)
                except Exception as exc:
                    node.get_logger().error(f"{transition}: {exc}")
                    return results.FAILURE
                return results.SUCCESS

            return on_transition

        return type("Managed", (lifecycle.LifecycleNode,), {f"on_{name}": callback(name) for name in TRANSITIONS})

    def manage(self, change: Callable[[str], object]) -> bool:
        """Answer lifecycle managers from now on; see `Graph.manage`."""
        if self._managed:
            self._change = change
            self._spin()
        return self._managed

    def _spin(self) -> None:
        if not self._thread.ident:
            self._thread.start()

    def parameter(self, name: str, default: Any) -> Any:
        """Declare a parameter; see `Graph.parameter`."""
        descriptor = import_module("rcl_interfaces.msg").ParameterDescriptor(read_only=True)
        try:
            return self._node.declare_parameter(name, default, descriptor).value
        except Exception as exc:
            raise OptionError(f"the parameter {name} is not of type {type(default).__name__}: {exc}") from exc

    def advertise(self, topic: str, message_type: str) -> _RclpyOutput:
        """Begin to publish; see `Graph.advertise`."""
        kind, profile = _class_of(message_type), self._profile("RELIABLE", PUBLISHED_DEPTH)
        try:
            return _RclpyOutput(self._node.create_publisher(kind, topic, profile))
        except Exception as exc:  # of rclpy, for a name
            raise OptionError(f"rclpy does not publish on {topic!r}: {exc}") from exc

    def subscribe(self, topic: str, message_type: str, receive: Callable[[bytes], None]) -> None:
        """Receive messages; see `Graph.subscribe`. They come from now on."""
        kind, profile = _class_of(message_type), self._profile("BEST_EFFORT", RECEIVED_DEPTH)
        try:
            self._node.create_subscription(kind, topic, receive, profile, raw=True)
        except Exception as exc:
            raise OptionError(f"rclpy does not subscribe to {topic!r}: {exc}") from exc
        self._spin()

    def _profile(self, reliability: str, depth: int) -> Any:
        return self._qos.QoSProfile(
            reliability=getattr(self._qos.ReliabilityPolicy, reliability),
            durability=self._qos.DurabilityPolicy.VOLATILE,
            history=self._qos.HistoryPolicy.KEEP_LAST,
            depth=depth,
        )

    def close(self) -> None:
        """End the node; more calls have no effect."""
        if self._context.ok():
            self._executor.shutdown()
            if self._thread.ident:
                self._thread.join(5.0)
            self._node.destroy_node()
            self._rclpy.shutdown(context=self._context)


class _RclpyOutput:
    def __init__(self, publisher: Any) -> None:
        self._publisher = publisher

    @property
    def is_wanted(self) -> bool:
        return bool(self._publisher.get_subscription_count())

    def publish(self, data: bytes) -> None:
        self._publisher.publish(data)


def _class_of(message_type: str) -> Any:
    package, kind, name = message_type.split("/")
    try:
        return getattr(import_module(f"{package}.{kind}"), name)
    except ImportError as exc:
        raise OptionError(
            f"the package {package} of ROS 2 is not installed ({exc}); install "
            f"ros-DISTRIBUTION-{package.replace('_', '-')}"
        ) from exc
