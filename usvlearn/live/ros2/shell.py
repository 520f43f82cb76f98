"""The node in ROS 2: `usvlearn live ros2 FOLDER --ros-args -p NAME:=VALUE …`. rclpy comes from the user's ROS.

Subscriptions are best effort and volatile, which matches every publisher: a reliable subscription would not match the
sensors that publish best effort, and a lost sample is masked, not waited for. Publishers are reliable, which matches
every subscriber. What changes seldom (parameters, alarms) is transient local, so that a late subscriber gets it, too.
"""

from __future__ import annotations

import argparse
import importlib
import math
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from usvlearn.errors import ConfigError, did_you_mean
from usvlearn.live.alarms import ACKNOWLEDGE, RESET
from usvlearn.live.ros2.messages import (
    AUXILIARY,
    CLASSES,
    DEFAULTS,
    NAME,
    NS,
    TRACK_CLASSES,
    Messages,
    Outputs,
    choose_topics,
    message_class,
)
from usvlearn.live.session import Session
from usvlearn.live.start import NAMED, Middleware, Options, add_arguments, options_of, until_signal
from usvlearn.live.status import StatusLine
from usvlearn.logs.alignment.mixing import SOURCE_KEYS
from usvlearn.logs.channels.channel import QUOTED
from usvlearn.logs.formats.ros.message_fields import CLOCKS

PREFIX = "channels."
PATHS = ("folder", "start", "tensorboard")
OWN = {"frame_id": "base_link", "clock": "header", "members": False}  # and their defaults
KINDS: dict[str, tuple[type, ...]] = {  # of all options; a whole number is legal where a number is
    **dict.fromkeys((*PATHS, "boat", "page", "frame_id", "clock"), (str,)),
    **dict.fromkeys(("mass", "surge_max", "save_period", "patience"), (float, int)),
    "keep": (int,),
    **dict.fromkeys(("record", "refit", "members"), (bool,)),
}
OF_ROS = ("use_sim_time", "start_type_description_service")
PREFIXES_OF_ROS = ("qos_overrides.",)
MEANING = {str: "text", bool: "true or false", int: "a whole number", float: "a number"}


class Given(NamedTuple):
    """What the user has given as parameters."""

    options: dict[str, Any]  # of `usvlearn.live.start.Options`
    own: dict[str, Any]  # of `OWN`, complete
    channels: dict[str, dict[str, Any]]  # channel -> option of a `Source` -> value


def given_by(parameters: Mapping[str, Any]) -> Given:
    """Sort parameters, by their full names."""
    given = Given({}, dict(OWN), {})
    for name, value in parameters.items():
        if name in OF_ROS or name.startswith(PREFIXES_OF_ROS):
            continue
        if name.startswith(PREFIX):
            channel, _, key = name.removeprefix(PREFIX).partition(".")
            if channel not in NAMED or key not in SOURCE_KEYS:
                raise _unknown(name, (PREFIX + f"{each}.{option}" for each in NAMED for option in SOURCE_KEYS))
            given.channels.setdefault(channel, {})[key] = _plain(value)
            continue
        if name not in KINDS:
            raise _unknown(name, KINDS)
        if not isinstance(value, KINDS[name]) or (isinstance(value, bool) and bool not in KINDS[name]):
            raise ConfigError(f"parameter {name}: found {value!r:.60}, expected {MEANING[KINDS[name][0]]}")
        if name in OWN:
            given.own[name] = value
        elif value != "":  # an empty text leaves the default, as a launch file may pass it
            given.options[name] = Path(str(value)).expanduser() if name in PATHS else value
    if given.own["clock"] not in CLOCKS:
        raise ConfigError(f"parameter clock: found {given.own['clock']!r}, expected one of {', '.join(CLOCKS)}")
    return given


def with_parameters(options: Options, given: Given) -> Options:
    """The options of the command line, with the parameters in their place."""
    channels = {name: dict(each) for name, each in options.channels.items()}
    for name, each in given.channels.items():
        channels[name] = channels.get(name, {}) | each
    return replace(options, **given.options, channels=channels)


def _unknown(name: str, known: Iterable[str]) -> ConfigError:
    return ConfigError(f"parameter {name}: found no such parameter{did_you_mean(name, known)}")


def _plain(value: Any) -> Any:
    """The arrays of ROS as lists."""
    return list(value) if hasattr(value, "__len__") and not isinstance(value, str) else value


QUEUE = 100  # messages of a topic that wait for the node: 1 s at 100 Hz
DEPTH = 10  # messages of ours that wait for a slow subscriber
TICK = 1.0  # s of wall time
PARAMETERS_EVERY = 5  # ticks
WAIT = 0.2  # s between two looks at signals
READER = "usvlearn.logs.formats.ros.rosbag.Rosbag"  # the names in a checkpoint that it was learned from are topics
HERE = Path(__file__).parent
LAUNCH, EXAMPLE = HERE / "ros2_launch.py", HERE / "ros2_example.yaml"
MISSING = (
    "rclpy cannot be imported{}: source your ROS 2 in this shell (source /opt/ros/DISTRIBUTION/setup.bash), and use "
    "the Python for which it is built"
)


def ros() -> Any:
    """The package rclpy."""
    try:
        return importlib.import_module("rclpy")
    except ImportError as error:
        reason = "" if isinstance(error, ModuleNotFoundError) and error.name == "rclpy" else f" ({error})"
        raise ConfigError(MISSING.format(reason)) from error


BOUND = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE", "CYCLONEDDS_URI")  # may name an interface
OPEN = (
    "DDS listens on all addresses of this computer: who reaches it can feed the node. The page 'The node in ROS 2' "
    "tells how to bind it to loopback"
)


class Shell:
    """Joins a session to a node of rclpy."""

    def __init__(
        self, node: Any, session: Session, frame_id: str = "base_link", clock: str = "header", members: bool = False
    ):
        qos = importlib.import_module("rclpy.qos")
        self._node, self._session = node, session
        self._dt = float(session.setup.align["dt"])  # s
        simulated = bool(node.get_parameter("use_sim_time").value)
        self._messages = Messages(session, clock, simulated)
        self._types = {name: message_class(f"{package}/msg/{name}") for name, package in CLASSES.items()}
        self._outputs, types = Outputs(self._types, frame_id), self._types
        self._listen = qos.QoSProfile(
            depth=QUEUE, reliability=qos.ReliabilityPolicy.BEST_EFFORT, durability=qos.DurabilityPolicy.VOLATILE
        )
        last = qos.QoSProfile(depth=DEPTH, durability=qos.DurabilityPolicy.TRANSIENT_LOCAL)
        speed, table, text, health = (
            types[name] for name in ("TwistWithCovarianceStamped", "Float64MultiArray", "String", "DiagnosticArray")
        )
        self._publishers = {
            "predicted": node.create_publisher(speed, "~/surge_predicted", DEPTH),
            "next": node.create_publisher(speed, "~/surge_next", DEPTH),
            "forecast": node.create_publisher(table, "~/forecast", DEPTH),
            "health": node.create_publisher(health, "~/health", DEPTH),
            "diagnostics": node.create_publisher(health, "/diagnostics", DEPTH),
            "parameters": node.create_publisher(text, "~/parameters", last),
            "alarm": node.create_publisher(text, "~/alarm", last),
            "event": node.create_publisher(text, "~/event", last),
            "planned": node.create_publisher(text, "~/plan_forecast", DEPTH),
        }
        self._plans = node.create_subscription(text, "~/plan", self.plan, DEPTH)
        try:
            trigger = importlib.import_module("std_srvs.srv").Trigger
            self._services = [
                node.create_service(trigger, f"~/{answer}_alarm", self._answerer(answer))
                for answer in (ACKNOWLEDGE, RESET)
            ]
        except ImportError:  # a file in the folder answers an alarm, too
            node.get_logger().info("std_srvs is not installed: no services answer alarms")
        if members:
            self._publishers["members"] = node.create_publisher(table, "~/members", DEPTH)
        self._subscriptions: dict[str, tuple[str, Any]] = {}  # topic -> type, subscription
        self._fields: dict[str, dict[str, str]] = {}  # topic -> part -> field
        self._problems: dict[str, str] = {}
        self._ticks, self._line = 0, StatusLine(node.get_name())
        clocks = importlib.import_module("rclpy.clock")
        steady = clocks.Clock(clock_type=clocks.ClockType.STEADY_TIME)  # it goes on while simulated time stands still
        self._timer = node.create_timer(TICK, self.tick, clock=steady)
        self.subscribe()

    def now(self) -> int:
        """The node's clock, ns; the simulated one with use_sim_time."""
        return self._node.get_clock().now().nanoseconds

    def subscribe(self) -> None:
        """Look for the topics, and subscribe to those that are new or have another type than before."""
        node = self._node
        kinds = {}

        def kinds_of(topic: str) -> list[str]:
            if topic not in kinds:
                kinds[topic] = [each.topic_type for each in node.get_publishers_info_by_topic(topic)]
            return kinds[topic]

        def resolve(name: str) -> str:
            try:
                return node.resolve_topic_name(name)
            except RuntimeError as error:  # of rclpy
                reason = str(error).partition(", at ")[0].rpartition(": ")[2]
                raise ConfigError(f"channels: found the topic {name[:QUOTED]!r}: {reason}: name another") from error

        published = {publisher.topic_name for publisher in self._publishers.values()}
        names = [name for name, _ in node.get_topic_names_and_types() if name not in published]
        current = {topic: kind for topic, (kind, _) in self._subscriptions.items()}
        chosen = choose_topics(self._session.sources, names, kinds_of, resolve, node.get_namespace(), current)
        self._fields, problems = chosen.fields, dict(chosen.problems)
        for topic, kind in chosen.topics.items():
            if current.get(topic) == kind:
                continue
            if topic in current:  # first: DDS lets a topic have one type in a process
                node.destroy_subscription(self._subscriptions.pop(topic)[1])
            try:
                subscription = node.create_subscription(message_class(kind), topic, self._receiver(topic), self._listen)
            except (ConfigError, RuntimeError) as error:  # rclpy raises a RuntimeError
                problems |= dict.fromkeys(chosen.fields[topic], f"{topic}: {' '.join(str(error).split())}")
                continue
            self._subscriptions[topic] = kind, subscription
            node.get_logger().info(f"reads {', '.join(chosen.fields[topic])} from {topic}, {kind}")
        for part, problem in problems.items():
            if self._problems.get(part) != problem:
                node.get_logger().info(f"{part}: {problem}")
        self._problems = problems

    def _receiver(self, topic: str) -> Callable[[Any], None]:
        def receive(message: Any) -> None:
            self.publish(self._messages.take(topic, self._fields.get(topic, {}), message, self.now()))

        return receive

    def publish(self, steps: list[Any]) -> None:
        """Publish steps, each speed with the time for which it is predicted; what is not known is not published."""
        out, send = self._outputs, self._publishers
        for step in steps:
            if not math.isnan(step.speed):
                send["predicted"].publish(out.speed(step.time, step.speed, step.low, step.high))
            if not math.isnan(step.next):
                send["next"].publish(out.speed(step.time + self._dt, step.next, step.next_low, step.next_high))
            if step.forecasts:
                send["forecast"].publish(out.forecast(step.forecasts, step.if_held))
            if step.track is not None:
                self._publish_track(step)
            if "members" in send and step.members:
                send["members"].publish(out.members(step.members))
            for event in step.events:
                send["event"].publish(out.text(event.sentence))
                if event.is_alarm:
                    send["alarm"].publish(out.text(event.sentence))
                self._node.get_logger().warning(event.sentence)

    def _publish_track(self, step: Any) -> None:
        """Publish where the boat will be; the topics are made with the first track."""
        if "track" not in self._publishers:
            classes = {name: message_class(f"{package}/msg/{name}") for name, package in TRACK_CLASSES.items()}
            self._types.update(classes)
            for key, topic, name in (
                ("track", "~/track", "Path"), ("place", "~/track_pose", "PoseWithCovarianceStamped"),
                ("place_if_held", "~/track_pose_if_held", "PoseWithCovarianceStamped"),
            ):  # fmt: skip
                self._publishers[key] = self._node.create_publisher(classes[name], topic, DEPTH)
        self._publishers["track"].publish(self._outputs.path(step.time, step.track))
        for name, places in (("place", step.places), ("place_if_held", step.places_if_held)):
            for horizon, point in places.items():
                k = max(round(horizon / self._dt), 1) - 1
                self._publishers[name].publish(self._outputs.place(step.time, step.track, k, point))

    def plan(self, message: Any) -> None:
        """Answer a plan."""
        self._publishers["planned"].publish(self._outputs.text(self._session.answer(message.data)))

    def _answerer(self, answer: str) -> Callable[[Any, Any], Any]:
        def take(_: Any, response: Any) -> Any:
            response.success, response.message = self._session.answer_alarm(answer), answer
            return response

        return take

    def tick(self) -> None:
        """Once a second: topics, health, saving."""
        now = self.now()
        self.publish(self._messages.notice(now))
        self.subscribe()
        health = self._session.tick()
        message = self._outputs.diagnostics(
            now / NS, self._node.get_name(), health, self._problems, self._messages.sentences()
        )
        self._publishers["health"].publish(message)
        self._publishers["diagnostics"].publish(message)
        if self._ticks % PARAMETERS_EVERY == 0:
            self._publishers["parameters"].publish(self._outputs.parameters(now / NS, health))
        self._ticks += 1
        self._line.show(health, self._session.last)

    def close(self) -> None:
        """End the line in the terminal."""
        self._line.close()


def run(session: Session, node: Any, **options: Any) -> int:
    """Serve with options of `Shell` until SIGINT or SIGTERM; returns the exit code. The session ends with it."""
    with until_signal() as stopped:
        executor = importlib.import_module("rclpy.executors").SingleThreadedExecutor()
        try:
            session.start()
            shell = Shell(node, session, **options)
            executor.add_node(node)
            while not stopped.is_set():
                executor.spin_once(timeout_sec=WAIT)
            shell.close()
        finally:
            print(f"usvlearn: {session.close()}", flush=True)
            executor.shutdown()
    return 0


def parser() -> argparse.ArgumentParser:
    """The arguments before --ros-args."""
    parser = argparse.ArgumentParser(
        prog="usvlearn live ros2",
        description="A node of ROS 2 that learns how its boat moves, and predicts its speed. Source your ROS 2 before.",
        epilog="What follows --ros-args goes to ROS: -p NAME:=VALUE, --params-file FILE, -r FROM:=TO. The options of a "
        "node are parameters, too, with _ for -: -p save_period:=60.0 comes before --save-period. Options of channels "
        "are parameters such as channels.surge.name.",
    )
    parser.add_argument("place", nargs="?", metavar="FOLDER", help="as --folder")
    parser.add_argument("--launch-file", action="store_true", help="print the path of a launch file, and end")
    parser.add_argument("--example", action="store_true", help="print an example of a file of parameters, and end")
    add_arguments(parser)
    return parser


def main(arguments: Sequence[str]) -> int:
    """The command; returns the exit code."""
    before_ros = list(arguments[: arguments.index("--ros-args")] if "--ros-args" in arguments else arguments)
    given = parser().parse_args(before_ros)
    if given.launch_file or given.example:
        print(LAUNCH if given.launch_file else EXAMPLE.read_text().rstrip())
        return 0
    if given.place is not None:
        given.folder = given.place
    options, rclpy = options_of(given), ros()
    signals = importlib.import_module("rclpy.signals").SignalHandlerOptions.NO
    try:
        rclpy.init(args=list(arguments[len(before_ros) :]), signal_handler_options=signals)
    except Exception as error:  # rclpy has its own errors for arguments that cannot be parsed
        raise ConfigError(f"--ros-args: {' '.join(str(error).split())}: see usvlearn live ros2 --help") from error
    try:
        node = rclpy.create_node(NAME, automatically_declare_parameters_from_overrides=True)
        parameters = given_by({name: each.value for name, each in node.get_parameters_by_prefix("").items()})
        node.add_on_set_parameters_callback(_refuse)
        session = Session(with_parameters(options, parameters), Middleware("ros2", READER, DEFAULTS, AUXILIARY))
        node.get_logger().info(session.sentence)
        if not any(os.environ.get(name) for name in BOUND):
            node.get_logger().info(OPEN)
        return run(session, node, **parameters.own)
    finally:
        rclpy.try_shutdown()


def _refuse(parameters: Any) -> Any:
    """Parameters are read once: a change while the node runs is refused, not ignored."""
    result = importlib.import_module("rcl_interfaces.msg").SetParametersResult
    return result(successful=False, reason="usvlearn reads its parameters at its start: start it anew")
