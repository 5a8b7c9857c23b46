"""``edgeperc ros2``: a live node, over Zenoh without a ROS installation, or by rclpy."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from ..errors import OptionError, SensorError
from ..system.printable import many
from ..types.choices import AUTO_SENSOR
from .arguments import (
    Commands,
    add_command,
    add_mounting,
    add_networks,
    chosen_models,
    keywords,
    options,
    positive,
    positive_number,
)
from .output import print_error, print_line
from .run import make_perceiver
from .scans import check_sensor, with_mounting

if TYPE_CHECKING:
    from ..perceiver import Perceiver
    from ..ros2.graph import Graph
    from ..ros2.odometry import Rolling


_REMEMBER_S, _SIZE_M = 10.0, 40.0


def add_parser(commands: Commands) -> None:
    """Add ``ros2``."""
    parser = add_command(
        commands,
        "ros2",
        ros2_command,
        help="a live ROS 2 node, with or without a ROS installation",
        description="Perceive the newest point cloud of a ROS 2 topic and publish classes of points, boxes, tracks and "
        "the drivable grid, until it is stopped (Ctrl-C). Clouds that are damaged or cannot be perceived are reported "
        "in /diagnostics and on stderr; the node goes on.\n\n"
        "Without --rclpy it needs no ROS installation: it speaks Zenoh with the nodes of rmw_zenoh_cpp "
        "(RMW_IMPLEMENTATION=rmw_zenoh_cpp), through their router.",
        examples=[
            "edgeperc ros2 --topic /points",
            "edgeperc ros2 --topic /ouster/points --connect tcp/192.168.1.10:7447",
            "edgeperc ros2 --rclpy --topic /points --ros-args -r __ns:=/front",
        ],
    )
    reading = options(parser, "input")
    reading("--topic NAME", "topic of sensor_msgs/PointCloud2 (default: %(default)s)", default="/points")
    reading(
        "--sensor SENSOR",
        "the LiDAR: a name from 'edgeperc sensors', or a .json file written by 'edgeperc fit-sensor' (default: "
        "the one that the first cloud names by its fields, frame, topic and rings)",
    )
    add_mounting(reading)
    reading(
        "--rate HZ",
        "scans per second of the sensor: an answer is late after two periods, stale after five (default: 10)",
        type=positive_number,
        default=10.0,
    )
    reading(
        "--anyway",
        "perceive scans that differ grossly from those that a model was trained on, too, with a warning (default: "
        "refuse them)",
    )
    add_networks(parser)
    output = options(parser, "output")
    output(
        "--prefix NAME",
        "name before those of the topics, as in NAME/points (default: %(default)s)",
        default="/edgeperc",
    )
    output(
        "--publish NAME[=TOPIC]...",
        "what to publish, and on which topic if not PREFIX/NAME: points, markers, occupancy, detections, "
        "diagnostics, ground_points, obstacle_points, rolling, detected_objects, tracked_objects, predicted_objects "
        "(default: the first seven, and rolling with --odometry)",
    )
    output("--no-track", "do not track the boxes from scan to scan")
    output(
        "--sweeps N",
        "find objects and the ground with the points of the last N clouds, 2 to 20, on what stands still: for sensors "
        "of few beams. The sensor moves as --odometry says, else as KISS-ICP finds (extra 'slam') (default: each cloud "
        "alone)",
        type=positive,
    )
    output("--frame NAME", "frame of the answers (default: that of the clouds)")
    output(
        "--grid-frame NAME",
        "frame of the grid: level, on the road below the sensor, x forward (default: that of the answers, with "
        "the pose of the ground in the grid's origin)",
    )
    memory = options(parser, "grid with memory")
    memory("--odometry NAME", "topic of nav_msgs/Odometry, for the output rolling and the tracks (default: none)")
    memory(
        "--sensor-pose X Y Z ROLL PITCH YAW",
        "of the clouds' frame in the odometry's child frame, in meters and degrees (default: the same if the "
        "names are the same; otherwise above its origin, mounted as for the perception)",
        type=float,
    )
    memory(
        "--remember SECONDS",
        "a cell that was not observed for longer is unknown again (default: 10)",
        type=positive_number,
        default=_REMEMBER_S,
    )
    memory("--grid-size METERS", "edge of the window (default: 40)", type=positive_number, default=_SIZE_M)
    graph = options(parser, "graph")
    graph("--name NAME", "name of the node (default: %(default)s)", default="edgeperc")
    graph("--namespace NAME", "namespace of the node (default: %(default)s)", default="/")
    graph("--domain N", "ROS domain (default: that of the variable ROS_DOMAIN_ID, or 0)", type=int)
    graph(
        "--connect ENDPOINT",
        "Zenoh endpoint of a router or a peer (default: the configuration that the variable "
        "ZENOH_SESSION_CONFIG_URI names, or tcp/localhost:7447)",
    )
    graph("--rclpy", "use rclpy of the sourced ROS installation, not Zenoh")
    graph(
        "--lifecycle",
        "with --rclpy: a lifecycle node, which waits unconfigured for its manager (default: active at once)",
    )
    graph(
        "--ros-args ARGUMENT",
        "with --rclpy, last: remappings, and parameters in place of the options above: topic, sensor, model, "
        "frame, grid_frame, prefix, rate, publish, sweeps, odometry, sensor_pose, remember, grid_size; such as "
        "-p sensor:=os1-64 (default: none)",
        nargs=argparse.REMAINDER,
        default=[],
    )
    graph("--scans N", "end after N perceived scans (default: when it is stopped)", type=positive)


def ros2_command(arguments: argparse.Namespace) -> int:
    """Run the node until it is stopped."""
    from ..ros2.node import USUAL_OUTPUTS, PerceptionNode
    from ..tracking.tracker import Tracker
    from ..zoo import resolve

    if arguments.sweeps is not None and arguments.no_track:
        arguments.usage_error("--sweeps needs tracks, to tell what stands; leave out --no-track")
    graph = _open_graph(arguments)
    try:
        _take_parameters(graph, arguments)
        check_sensor(arguments)
        for model in chosen_models(arguments):  # no cloud heals a wrong name, and the first may come late
            resolve(model)
        made = [] if arguments.sensor is None else [_perceiver(arguments, arguments.sensor)]

        def perceiver_for(cloud: Mapping[str, Any]) -> Perceiver:
            from ..readers.identify import of_cloud

            if arguments.sensor is not None:  # anew after a cleanup, which forgets
                return made.pop() if made else _perceiver(arguments, arguments.sensor)
            try:
                known = of_cloud(cloud)
            except SensorError as unnamed:
                try:
                    found = _perceiver(arguments, AUTO_SENSOR)
                except SensorError:
                    raise unnamed from None
                print_line("the clouds do not name their sensor: it is found in the points")
                return found
            print_line(f"{known.profile.name}, by {known.because}")
            return _perceiver(arguments, known.profile)

        node = PerceptionNode(
            graph,
            perceiver_for,
            topic=arguments.topic or "",
            tracker=None if arguments.no_track else Tracker(),
            prefix=arguments.prefix or "",
            outputs=arguments.publish or USUAL_OUTPUTS,
            rolling=_rolling(arguments),
            n_sweeps=arguments.sweeps,
            **keywords(arguments, "lifecycle", frame_id="frame", grid_frame_id="grid_frame", rate_hz="rate"),
        )
    except BaseException:
        graph.close()
        raise
    waiting = "unconfigured, waiting for its manager; clouds on" if node.is_managed else "waiting for clouds on"
    print_line(f"{graph.name}: {waiting} {arguments.topic}, publishing {arguments.prefix or ''}/*")
    n_answers, reported = 0, ""
    with node:
        try:
            for outcome in node:
                if isinstance(outcome, Exception):
                    if str(outcome) != reported:  # the same of every cloud is printed once; the diagnostics repeat it
                        print_error(f"{arguments.topic}: {outcome}")
                    reported = str(outcome)
                    continue
                reported = ""
                n_answers += 1
                if n_answers == 1:
                    print_line(f"perceiving: {many(outcome.perception.n_points, 'point')} in the first cloud")
                if n_answers == arguments.scans:
                    break
        finally:
            print_line(
                f"{many(node.n_scans, 'cloud')}: {n_answers} perceived, {node.n_dropped} dropped for newer ones, "
                f"{node.n_failed} failed"
            )
    return 0


def _open_graph(arguments: argparse.Namespace) -> Graph:
    names: dict[str, Any] = {"namespace": arguments.namespace, "domain": arguments.domain}
    if arguments.rclpy:
        from ..ros2.rclpy_graph import RclpyGraph

        if arguments.connect is not None:
            arguments.usage_error("--connect needs Zenoh; leave it out, or leave out --rclpy")
        return RclpyGraph(arguments.name, ros_args=arguments.ros_args, managed=arguments.lifecycle, **names)
    if arguments.lifecycle:
        arguments.usage_error("--lifecycle needs --rclpy: a node over Zenoh offers no services to a manager")
    from ..ros2.zenoh_graph import ZenohGraph

    if arguments.ros_args:
        arguments.usage_error("--ros-args needs --rclpy; add it, or pass the options of this command")
    return ZenohGraph(arguments.name, connect=arguments.connect, **names)


def _take_parameters(graph: Graph, arguments: argparse.Namespace) -> None:
    """Let parameters of the node replace options; ROS has no None, so an option that was not passed is empty."""
    for name in ("topic", "sensor", "frame", "grid_frame", "prefix", "odometry"):
        setattr(arguments, name, graph.parameter(name, getattr(arguments, name) or "") or None)
    arguments.model = [*filter(None, graph.parameter("model", arguments.model or [""]))] or None
    arguments.publish = [*filter(None, graph.parameter("publish", arguments.publish or [""]))] or None
    pose = [*graph.parameter("sensor_pose", arguments.sensor_pose or [0.0])]
    arguments.sensor_pose = None if pose == [0.0] else pose
    for name in ("rate", "remember", "grid_size"):
        setattr(arguments, name, graph.parameter(name, getattr(arguments, name)))
    arguments.sweeps = graph.parameter("sweeps", arguments.sweeps or 0) or None


def _rolling(arguments: argparse.Namespace) -> Rolling | None:
    from ..road.rolling import RollingGrid
    from ..ros2.odometry import Rolling

    if arguments.odometry is None:
        if arguments.sensor_pose is not None or (arguments.remember, arguments.grid_size) != (_REMEMBER_S, _SIZE_M):
            raise OptionError(
                "sensor_pose, remember and grid_size are of the grid with memory: pass --odometry NAME, too"
            )
        return None
    grid = RollingGrid(size_m=arguments.grid_size, remember_s=arguments.remember)
    return Rolling(arguments.odometry, arguments.sensor_pose, grid)


def _perceiver(arguments: argparse.Namespace, sensor: Any) -> Perceiver:
    mounted = with_mounting(sensor, arguments)
    mismatch: Any = "warn" if arguments.anyway else "refuse"
    made = make_perceiver(arguments, sensor=mounted, on_mismatch=mismatch, adapt=arguments.adapt)
    if made.sensor.pattern is not None:
        print_line(f"the points of the last {made.sensor.pattern.accumulate_s:g} s are taken as seen from one place")
    return made
