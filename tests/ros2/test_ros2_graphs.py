"""The two middlewares of the live node: Zenoh between processes, and rclpy's calls."""

from __future__ import annotations

import json
import os
import re
import shlex
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags")

from ros2_helpers import MESSAGES, Perceive, cloud, odometry, scans

from cli_helpers import Shell
from edgeperc import OptionError, Perceiver, SensorError, Tracker
from edgeperc.cli.main import main
from edgeperc.records import PerceivedScan
from edgeperc.road.grid import split_points
from edgeperc.ros2.messages import CLOUD, DIAGNOSTICS, LIVE_OUTPUTS, OUTPUTS
from edgeperc.ros2.node import PerceptionNode
from edgeperc.ros2.odometry import ODOMETRY, Rolling
from edgeperc.ros2.rclpy_graph import RclpyGraph
from edgeperc.ros2.zenoh_graph import CONFIG_VARIABLE, ZenohGraph, attachment, type_key
from edgeperc.types.sensor import get_sensor
from scenes import urban
from waiting import TIMEOUT_S, until

TESTS = Path(__file__).resolve().parent.parent
PAGE = TESTS.parent / "docs" / "howto" / "ros2.md"
POINT_CLOUD = (
    "sensor_msgs::msg::dds_::PointCloud2_/RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5"
)
POINTS = np.array([[10.0, 1.0, -1.0, 0.5], [5.0, -2.0, 0.25, 1.0]], np.float32)


def test_the_attachment_has_33_bytes() -> None:
    data = attachment(5, 1_700_000_000_000_000_007, bytes(range(16)))
    assert data == (5).to_bytes(8, "little") + (1_700_000_000_000_000_007).to_bytes(8, "little") + b"\x10" + bytes(
        range(16)
    )


def session(mode: str, endpoint: str, **more: Any) -> dict[str, Any]:
    """A Zenoh configuration that drops nothing on a busy computer."""
    patient = {"drop": {"wait_before_drop": 60_000_000, "max_wait_before_drop_fragments": 60_000_000}}
    return {
        "mode": mode,
        "listen" if mode == "router" else "connect": {"endpoints": [endpoint]},
        "scouting": {"multicast": {"enabled": False}},
        "transport": {"link": {"tx": {"queue": {"congestion_control": patient}}}},
        **more,
    }


@pytest.fixture
def router() -> Iterator[str]:
    """Zenoh's router, as rmw_zenohd is, at a port of its own on this computer."""
    zenoh = pytest.importorskip("zenoh")
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with zenoh.open(zenoh.Config.from_json5(json.dumps(session("router", endpoint)))):
        yield endpoint


class Watch:
    """A session beside the graph: every sample of some keys, and the liveliness tokens that are alive."""

    def __init__(self, endpoint: str) -> None:
        zenoh: Any = pytest.importorskip("zenoh")
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(session("client", endpoint))))
        self.samples: list[tuple[str, bytes, bytes]] = []
        self.tokens: set[str] = set()
        self.keep = [
            self.session.declare_subscriber("*/**", self._sample),
            self.session.liveliness().declare_subscriber("@ros2_lv/**", self._token, history=True),
        ]

    def _sample(self, sample: Any) -> None:
        beside = b"" if sample.attachment is None else sample.attachment.to_bytes()
        self.samples.append((str(sample.key_expr), sample.payload.to_bytes(), beside))

    def _token(self, sample: Any) -> None:
        change = self.tokens.add if str(sample.kind).endswith("PUT") else self.tokens.discard
        change(str(sample.key_expr))


@pytest.fixture
def watch(router: str) -> Iterator[Watch]:
    found = Watch(router)
    yield found
    found.session.close()


def test_a_node_is_seen_and_heard_as_one_of_rmw_zenoh(router: str, watch: Watch) -> None:
    heard: list[bytes] = []
    graph = ZenohGraph("top", namespace="/front", domain=7, connect=router)
    other = ZenohGraph("other", domain=7, connect=router)
    elsewhere = ZenohGraph("other", domain=8, connect=router)
    try:
        assert graph.name == "/front/top"
        assert graph.parameter("sensor", "os1-64") == "os1-64"
        assert not graph.manage(print)
        output = graph.advertise("points", CLOUD)
        graph.subscribe("/in", CLOUD, heard.append)
        zid = next(token.split("/")[2] for token in _of(watch, "top", 3))
        space = f"@ros2_lv/7/{zid}/0"
        assert _of(watch, "top", 3) == {
            f"{space}/0/NN/%/%front/top",
            f"{space}/1/MP/%/%front/top/%front%points/{POINT_CLOUD}/::,10:,:,:,,",
            f"{space}/2/MS/%/%front/top/%in/{POINT_CLOUD}/2::,5:,:,:,,",
        }
        until(lambda: output.is_wanted)  # the watch hears everything
        output.publish(b"one")
        output.publish(b"two")
        until(lambda: len(watch.samples) == 2)
        assert [(key, data) for key, data, _ in watch.samples] == [
            (f"7/front/points/{POINT_CLOUD}", b"one"),
            (f"7/front/points/{POINT_CLOUD}", b"two"),
        ]
        first, second = (beside for _, _, beside in watch.samples)
        assert (first[:8], second[:8]) == ((1).to_bytes(8, "little"), (2).to_bytes(8, "little"))
        assert first[16:] == second[16:]
        assert first[16] == 16
        for each in (elsewhere, other):
            talker = each.advertise("/in", CLOUD)
            until(lambda talker=talker: talker.is_wanted)  # type: ignore[misc]
            talker.publish(each.name.encode() if each is other else b"of another domain")
        until(lambda: heard)
        assert heard == [b"/other"]
    finally:
        for each in (graph, other, elsewhere):
            each.close()
            each.close()
    until(lambda: not watch.tokens)


def _of(watch: Watch, name: str, n: int) -> set[str]:
    """The n tokens of a node."""

    def found() -> set[str]:
        return {token for token in set(watch.tokens) if name in token.split("/")[8]}

    until(lambda: len(found()) == n)
    return found()


@pytest.mark.parametrize(
    ("options", "environment", "said"),
    [
        ({"domain": 233}, {}, "domain is 233"),
        ({}, {"ROS_DOMAIN_ID": "seven"}, "ROS_DOMAIN_ID is 'seven'"),
        ({"connect": "nonsense"}, {}, "connect='nonsense'"),
        ({}, {CONFIG_VARIABLE: "/nowhere.json5"}, "nowhere.json5"),
        ({"name": "two words"}, {}, "not a name of ROS 2"),
    ],
)
def test_what_is_no_graph(
    options: dict[str, Any], environment: dict[str, str], said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("zenoh")
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(OptionError, match=said):
        ZenohGraph(**options)


def test_that_no_router_answers_is_said(router: str) -> None:
    with socket.create_server(("localhost", 0)) as server:
        nobody = f"tcp/localhost:{server.getsockname()[1]}"
    for endpoint in (nobody, router):
        graph = ZenohGraph(connect=endpoint)
        said = pytest.warns(UserWarning, match=rf"no router and no peer answers yet \({nobody}\)")
        with said if endpoint == nobody else nullcontext():
            graph.subscribe("/points", "sensor_msgs/msg/PointCloud2", lambda _: None)
        graph.close()


def test_the_command_of_the_page_answers_another_process(router: str, watch: Watch, tmp_path: Path) -> None:
    """One process publishes simulated scans, one is the node; their messages are those that are made here."""
    pytest.importorskip("onnxruntime")
    page = PAGE.read_text("utf-8")
    (command,) = re.findall(r"^\$ edgeperc (ros2 --topic /points)$", page, flags=re.M)
    config = session("peer", router, listen={"endpoints": ["tcp/127.0.0.1:0"]})
    (tmp_path / "session.json5").write_text(json.dumps(config))
    environment = {**os.environ, CONFIG_VARIABLE: str(tmp_path / "session.json5"), "ROS_DOMAIN_ID": "0"}
    log = tmp_path / "log"
    with log.open("w") as file:
        node = subprocess.Popen(
            [sys.executable, "-m", "edgeperc", *shlex.split(command)], env=environment, stdout=file, stderr=file
        )
    try:
        # The watch hears every topic, so a publisher is wanted from the start; the node must be there before it.
        assert len(_of(watch, "edgeperc", 9)) == 9, log.read_text()  # the node, seven topics, one subscription
        publisher = [sys.executable, str(TESTS / "ros2_helpers.py"), "3"]
        done = subprocess.run(publisher, env=environment, capture_output=True, text=True, timeout=2.0 * TIMEOUT_S)
        assert done.returncode == 0, (done.stderr, log.read_text(), [key for key, _, _ in watch.samples])

        def heard(name: str) -> list[bytes]:
            topic = "diagnostics" if name == "diagnostics" else f"edgeperc/{name}"
            key = f"0/{topic}/{type_key(LIVE_OUTPUTS[name])}/{MESSAGES.type_hash(LIVE_OUTPUTS[name])}"
            return [data for found, data, _ in list(watch.samples) if found == key]

        _compare(heard)
        until(lambda: any(_status(raw).level == 2 for raw in heard("diagnostics")))
        status = next(_status(raw) for raw in heard("diagnostics") if _status(raw).level == 2)
        assert "are not a sensor_msgs/msg/PointCloud2" in status.message
        values = {v.key: v.value for v in status.values}
        assert (values["answers"], values["clouds failed"], values["clouds dropped"]) == ("3", "1", "0")
        node.send_signal(signal.SIGTERM)
        assert node.wait(60.0) == 143, log.read_text()
        until(lambda: not watch.tokens)
    finally:
        node.kill()
        node.wait()
    said = log.read_text().splitlines()
    # What the page shows, with the sensor's line shortened there.
    shown = re.search(r"^\$ edgeperc ros2 --topic /points\n(.*?)```", page, flags=re.M | re.S)
    for line in shown[1].splitlines():
        assert any(line in each for each in said), (line, said)


def _status(raw: bytes) -> Any:
    return MESSAGES.decode(raw, DIAGNOSTICS).status[0]


def _compare(heard: Callable[[str], list[bytes]]) -> None:
    """Hold the node's messages against those of a perceiver in this process, byte by byte."""
    names = [name for name in OUTPUTS if name != "diagnostics"]
    for name in names:
        until(lambda name=name: len(heard(name)) == 3)  # type: ignore[misc]
    sensor = replace(get_sensor("hdl-64e"), remission_range=(0.0, 255.0))
    perceive, tracker = Perceiver(sensor=sensor), Tracker()
    MESSAGES.frame_id = "velodyne_hdl64e"
    for k, points in enumerate(scans(3)):
        stamp_ns = 10**18 + k * 10**8
        perception = perceive(points, stamp_s=stamp_ns * 1e-9)
        scan = PerceivedScan("", stamp_ns * 1e-9, points, perception, tracker(perception), sensor, "OK")
        assert len(scan.perception.boxes) > 2
        for name in names:
            assert heard(name)[k] == MESSAGES.encode(getattr(MESSAGES, name)(scan, stamp_ns)), name
        parts = split_points(perception, points, sensor=sensor)
        source = MESSAGES.decode(cloud(points, stamp_ns, "velodyne_hdl64e"), CLOUD)
        for name, mask in zip(("ground_points", "obstacle_points"), parts, strict=True):
            until(lambda name=name, k=k: len(heard(name)) > k)  # type: ignore[misc]
            assert heard(name)[k] == MESSAGES.encode(MESSAGES.part(scan, source, mask, stamp_ns)), name
        assert 0.3 < parts.ground.mean() < 0.8


class Bus:
    """The few calls of rclpy that the node makes, within this process; it refuses any other."""

    def __init__(self) -> None:
        self.subscriptions: dict[str, list[Callable[[bytes], None]]] = {}
        self.profiles: dict[str, Any] = {}
        self.arguments: list[str] = []
        self.overrides: dict[str, Any] = {}
        self.ended: list[str] = []
        self.transitions: dict[str, Callable[[], str]] = {}
        self.logged: list[str] = []

    def modules(self) -> dict[str, SimpleNamespace]:
        bus = self

        class Context:
            def __init__(self) -> None:
                self.up = False

            def ok(self) -> bool:
                return self.up

        class Executor:
            def __init__(self, context: Any) -> None:
                self.over = threading.Event()

            def add_node(self, node: Any) -> None: ...

            def spin(self) -> None:
                self.over.wait()

            def shutdown(self) -> None:
                self.over.set()

        class Publisher:
            def __init__(self, topic: str) -> None:
                self.topic = topic

            def get_subscription_count(self) -> int:
                return len(bus.subscriptions.get(self.topic, []))

            def publish(self, data: bytes) -> None:
                assert isinstance(data, bytes)
                for receive in bus.subscriptions.get(self.topic, []):
                    receive(data)

        class Node:
            def __init__(self, name: str, namespace: str) -> None:
                self.name = f"{namespace.rstrip('/')}/{name}"

            def get_fully_qualified_name(self) -> str:
                return self.name

            def declare_parameter(self, name: str, default: Any, descriptor: Any) -> Any:
                assert descriptor.read_only
                value = bus.overrides.get(name, default)
                if type(value) is not type(default):
                    raise TypeError(f"wrong parameter type of {name}")
                return SimpleNamespace(value=value)

            def get_logger(self) -> Any:
                return SimpleNamespace(error=bus.logged.append)

            def create_publisher(self, kind: type, topic: str, profile: Any) -> Publisher:
                assert kind.__name__ in {name.rpartition("/")[2] for name in LIVE_OUTPUTS.values()}
                if " " in topic:
                    raise ValueError("topic name is invalid")
                bus.profiles[topic] = profile
                return Publisher(topic)

            def create_subscription(self, kind: type, topic: str, receive: Any, profile: Any, *, raw: bool) -> None:
                assert raw
                assert kind.__name__ in ("PointCloud2", "Odometry")
                if " " in topic or not topic:
                    raise ValueError("topic name is invalid")
                bus.profiles[topic] = profile
                bus.subscriptions.setdefault(topic, []).append(receive)

            def destroy_node(self) -> None:
                bus.ended.append(self.name)

        class LifecycleNode(Node):
            """As rclpy's: the methods are taken once, when a node is made."""

            def __init__(self, name: str, *, context: Context, namespace: str) -> None:
                super().__init__(name, namespace)
                for transition in ("configure", "activate", "deactivate", "cleanup", "shutdown"):
                    on_transition = getattr(self, f"on_{transition}")
                    bus.transitions[transition] = lambda on_transition=on_transition: on_transition(None)  # type: ignore[misc]

        def init(*, args: list[str], context: Context, domain_id: int | None, signal_handler_options: str) -> None:
            assert signal_handler_options == "none"
            context.up, bus.arguments = True, args

        def shutdown(*, context: Context) -> None:
            context.up = False

        def create_node(name: str, *, context: Context, namespace: str) -> Node:
            assert context.ok()
            return Node(name, namespace)

        messages = {
            "sensor_msgs": ("PointCloud2",),
            "visualization_msgs": ("MarkerArray",),
            "nav_msgs": ("OccupancyGrid", "Odometry"),
            "diagnostic_msgs": ("DiagnosticArray",),
        }
        return {
            "rclpy": SimpleNamespace(Context=Context, init=init, shutdown=shutdown, create_node=create_node),
            "rclpy.executors": SimpleNamespace(SingleThreadedExecutor=Executor),
            "rclpy.qos": SimpleNamespace(
                QoSProfile=lambda **fields: fields,
                ReliabilityPolicy=SimpleNamespace(RELIABLE="reliable", BEST_EFFORT="best effort"),
                DurabilityPolicy=SimpleNamespace(VOLATILE="volatile"),
                HistoryPolicy=SimpleNamespace(KEEP_LAST="keep last"),
            ),
            "rclpy.lifecycle": SimpleNamespace(
                LifecycleNode=LifecycleNode,
                TransitionCallbackReturn=SimpleNamespace(SUCCESS="success", FAILURE="failure"),
            ),
            "rclpy.signals": SimpleNamespace(SignalHandlerOptions=SimpleNamespace(NO="none")),
            "rcl_interfaces.msg": SimpleNamespace(ParameterDescriptor=SimpleNamespace),
            **{
                f"{package}.msg": SimpleNamespace(**{name: type(name, (), {}) for name in names})
                for package, names in messages.items()
            },
        }


@pytest.fixture
def bus(monkeypatch: pytest.MonkeyPatch) -> Bus:
    made = Bus()
    for name, module in made.modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setitem(sys.modules, "vision_msgs.msg", None)
    return made


def test_the_node_by_rclpy(bus: Bus) -> None:
    graph = RclpyGraph("top", namespace="/front", ros_args=["-r", "a:=b"])
    assert graph.name == "/front/top"
    assert bus.arguments == ["edgeperc", "--ros-args", "-r", "a:=b"]
    answers: list[bytes] = []
    bus.subscriptions["/edgeperc/points"] = [answers.append]
    with pytest.warns(UserWarning, match="vision_msgs of ROS 2 is not installed"):
        node = PerceptionNode(graph, lambda _: Perceive(), topic="/points")  # type: ignore[arg-type, return-value]
    with node:
        bus.subscriptions["/points"][0](cloud(POINTS))
        scan = next(iter(node))
        MESSAGES.frame_id = "velodyne"
        assert answers == [MESSAGES.encode(MESSAGES.points(scan, 10**9))]
    assert bus.ended == ["/front/top"]
    sensor_data = {"reliability": "best effort", "durability": "volatile", "history": "keep last", "depth": 5}
    assert bus.profiles["/points"] == sensor_data
    assert bus.profiles["/edgeperc/markers"] == {**sensor_data, "reliability": "reliable", "depth": 10}
    graph.close()
    assert bus.ended == ["/front/top"]


def test_a_lifecycle_manager_leads_the_node(bus: Bus) -> None:
    graph = RclpyGraph("top", managed=True)
    node = PerceptionNode(graph, lambda _: Perceive(), outputs=["points"], lifecycle=True)  # type: ignore[arg-type, return-value]
    bus.subscriptions["/edgeperc/points"] = [lambda _: None]
    with node:
        assert (node.is_managed, node.state, [*bus.profiles]) == (True, "unconfigured", [])
        assert bus.transitions["activate"]() == "failure"
        assert "does not begin at unconfigured" in bus.logged[0]
        for transition, state in (
            ("configure", "inactive"),
            ("activate", "active"),
            ("deactivate", "inactive"),
            ("activate", "active"),
        ):
            assert (bus.transitions[transition](), node.state) == ("success", state)
        (receive,) = bus.subscriptions["/points"]
        receive(cloud(POINTS))
        assert isinstance(next(iter(node)), PerceivedScan)
        assert (bus.transitions["deactivate"](), bus.transitions["cleanup"]()) == ("success", "success")
        assert (bus.transitions["shutdown"](), node.state) == ("success", "finalized")
        assert [*node] == []


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"prefix": "/a b"}, r"rclpy does not publish on '/a b/points'"),
        ({"topic": "/a b"}, "rclpy does not subscribe to '/a b'"),
        ({"outputs": ("points=~/points",)}, "not a name of ROS 2"),
        ({"outputs": ("points=1/x",)}, "not a name of ROS 2"),
        ({"outputs": ("tracked_objects",)}, "ros-DISTRIBUTION-autoware-perception-msgs"),
    ],
)
def test_what_rclpy_refuses(bus: Bus, options: dict[str, Any], said: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "autoware_perception_msgs.msg", None)
    graph = RclpyGraph("top")
    with pytest.raises(OptionError, match=said):
        PerceptionNode(graph, lambda _: Perceive(), **{"outputs": ("points",), **options})  # type: ignore[arg-type, return-value]
    graph.close()


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"publish": ["points", "boxes"]}, "outputs has 'boxes'"),
        ({"publish": ["rolling"]}, "needs poses"),
        ({"sensor_pose": [1.0, 0.0, 1.5, 0.0, 0.0, 90.0]}, "pass --odometry"),
        ({"grid_size": 20.0}, "pass --odometry"),
        ({"publish": "points"}, "the parameter publish is not of type list"),
        ({"odometry": "/odom", "sensor_pose": [1.0, 2.0]}, "sensor_pose is"),
        ({"odometry": "/odom", "remember": -1.0}, "remember_s is -1"),
        ({"odometry": "/odom", "remember": 5}, "the parameter remember is not of type float"),
        ({"odometry": "/odom", "grid_size": 0.0}, "size_m is 0"),
        ({"odometry": "an odometry"}, "not a name of ROS 2"),
        ({"rate": -1.0}, "--rate is -1"),
        ({"topic": "a topic"}, "rclpy does not subscribe to 'a topic'"),
        ({"topic": ""}, "rclpy does not subscribe to ''"),
        ({"prefix": ""}, "share the topic /points"),
        ({"odometry": "/points"}, "share the topic /points"),
        ({"model": ["nothing"]}, "no model is called 'nothing'"),
        ({"topic": "/other", "rate": 20.0, "sensor": "no such sensor"}, "no such sensor"),
        ({"rate": 20}, "the parameter rate is not of type float"),
        ({"sweeps": 30}, "n_sweeps is 30; expected a whole number from 2 to 20"),
    ],
)
@pytest.mark.filterwarnings("ignore:no detections are published")
def test_parameters_are_validated(overrides: dict[str, Any], said: str, bus: Bus, shell: Shell) -> None:
    bus.overrides = overrides
    assert said in shell.err("ros2", "--rclpy", "--ros-args", "-p", "sensor:=x")
    assert bus.ended == ["/edgeperc"]


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Callable[[dict[str, Any]], Perceiver], dict[str, Any]]]:
    """In place of nodes: what makes the perceiver of each, and its options."""
    found = []

    def node(_: Any, perceiver_for: Callable[[dict[str, Any]], Perceiver], **options: Any) -> Any:
        found.append((perceiver_for, options))
        raise OptionError("no node")

    monkeypatch.setattr("edgeperc.ros2.node.PerceptionNode", node)
    return found


def test_parameters_make_the_grid_with_memory(bus: Bus, made: list[Any]) -> None:
    bus.overrides = {
        "odometry": "/odometry/filtered",
        "sensor_pose": [1.0, 0.0, 1.5, 0.0, 0.0, 90.0],
        "grid_size": 20.0,
        "publish": ["rolling=/grid", "ground_points"],
        "sweeps": 5,
    }
    assert main(["ros2", "--rclpy", "--lifecycle"]) == 2
    ((_, options),) = made
    assert (options["outputs"], options["lifecycle"]) == (["rolling=/grid", "ground_points"], True)
    assert options["n_sweeps"] == 5
    rolling = options["rolling"]
    assert (rolling.topic, rolling.sensor_pose) == ("/odometry/filtered", [1.0, 0.0, 1.5, 0.0, 0.0, 90.0])
    assert rolling.grid.values().shape == (100, 100)


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_clouds_that_do_not_name_their_sensor_show_it(
    bus: Bus, made: list[Any], capsys: pytest.CaptureFixture[str]
) -> None:
    for words in ([], ["--mount-height", "1.7"], ["--sensor", "vlp-32c"]):
        assert main(["ros2", *words, "--rclpy"]) == 2
    cloud = {"topic": "/points", "frame": "lidar", "fields": ["x", "y", "z", "intensity"], "elevations_deg": []}
    perceive = made[0][0](cloud)
    assert "found in the points" in capsys.readouterr().out
    perceive(urban(3, "vlp-32c").points)
    assert perceive.sensor.name == "vlp-32c"
    with pytest.raises(SensorError, match="do not name their sensor"):  # the mounting is a part of the profile
        made[1][0](cloud)
    assert made[2][0](cloud) is not made[2][0](cloud)  # the second time after a cleanup, which forgets


def test_the_grid_with_memory_over_zenoh(router: str, watch: Watch) -> None:
    graph, talker = ZenohGraph("top", connect=router), ZenohGraph("base", connect=router)
    node = PerceptionNode(graph, lambda _: Perceive(), outputs=["rolling=/grid"], rolling=Rolling())  # type: ignore[arg-type, return-value]
    with node:
        odom, lidar = talker.advertise("/odom", ODOMETRY), talker.advertise("/points", CLOUD)
        until(lambda: odom.is_wanted and lidar.is_wanted)
        odom.publish(odometry(10**9, 3.0, 4.0, 0.0))
        outcomes = iter(node)

        def grids() -> list[bytes]:
            """What came on /grid so far, after one more cloud: the pose may be on its way."""
            lidar.publish(cloud(POINTS))
            assert isinstance(next(outcomes), PerceivedScan)
            return [data for key, data, _ in list(watch.samples) if key.startswith("0/grid/")]

        until(grids)
        grid = MESSAGES.decode(grids()[0], LIVE_OUTPUTS["rolling"])
        assert (grid.header.frame_id, grid.info.width) == ("odom", 200)
        assert (grid.info.origin.position.x, grid.info.origin.position.y) == pytest.approx((-17.0, -16.0), abs=0.21)
        assert 100 in grid.data
    talker.close()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--ros-args", "-r", "a:=b"], "--ros-args needs --rclpy"),
        (["--rclpy", "--connect", "tcp/localhost:1"], "--connect needs Zenoh"),
        (["--lifecycle"], "--lifecycle needs --rclpy"),
        (["--sweeps", "5", "--no-track"], "--sweeps needs tracks"),
    ],
)
def test_options_that_exclude_one_another(arguments: list[str], said: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["ros2", *arguments])
    assert said in capsys.readouterr().err


def test_without_rclpy_it_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rclpy", None)
    with pytest.raises(OptionError, match=r"setup\.bash"):
        RclpyGraph()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of rclpy's own imports
def test_over_the_real_rclpy() -> None:
    """Where ROS is installed: the bytes pass its middleware, and its own classes read them."""
    pytest.importorskip("rclpy")
    from rclpy.serialization import deserialize_message
    from sensor_msgs.msg import PointCloud2

    talker = RclpyGraph("talker")
    listener = RclpyGraph("listener")
    heard: list[bytes] = []
    try:
        listener.subscribe("/edgeperc_test", CLOUD, heard.append)
        output = talker.advertise("/edgeperc_test", CLOUD)
        until(lambda: output.is_wanted)
        # The other side may discover the publisher later, so the first messages may be lost.
        until(lambda: output.publish(cloud(POINTS)) or heard)
        assert MESSAGES.encode(MESSAGES.decode(heard[0], CLOUD)) == cloud(POINTS)
        assert bytes(deserialize_message(heard[0], PointCloud2).data) == POINTS.tobytes()
    finally:
        talker.close()
        listener.close()
