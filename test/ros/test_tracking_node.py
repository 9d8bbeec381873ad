from __future__ import annotations

import numpy as np
import pytest
from data.drifting_odometry import drifting
from data.room_camera import ANSWER_S, FAST, POSES, Camera
from data.ros_camera import BASE_FRAME, OPTICAL_FRAME, CameraDriver, Messages
from data.textured_room import PERIOD_NS, frame_at
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.qos import ReliabilityPolicy, qos_profile_sensor_data
from std_srvs.srv import SetBool, Trigger
from tf2_msgs.msg import TFMessage

from meslam_core.config import MeslamConfig
from meslam_core.se3 import exp, inverse
from meslam_core.slam import T_BODY_OPTICAL
from meslam_core.trajectory import Trajectory
from meslam_interfaces.msg import RegionModel, TrackingStatus
from meslam_ros import topics
from meslam_ros.client import MeslamClient
from meslam_ros.conversions import (
    NANOSECONDS,
    byte_array,
    from_transform,
    stamp_ns,
    to_pose,
    to_stamp,
)
from meslam_ros.odometry_node import OdometryNode
from meslam_ros.qos import STREAM, latched
from meslam_ros.region_messages import stored_region
from meslam_ros.tracking_node import TrackingNode
from meslam_ros.transforms import StaticBroadcaster


def diagnosed(client: MeslamClient) -> list[DiagnosticStatus]:
    """Collects what the nodes report on /diagnostics."""
    reports: list[DiagnosticStatus] = []
    client.node.create_subscription(
        DiagnosticArray, topics.DIAGNOSTICS, lambda m: reports.extend(m.status), STREAM
    )
    return reports


@pytest.mark.parametrize("reliability", list(ReliabilityPolicy)[1:3])
def test_every_frame_gets_a_pose_and_the_map_a_model(start_node, client, reliability) -> None:
    start_node(OdometryNode)
    start_node(TrackingNode, **FAST)
    models: list[RegionModel] = []
    covariances: list[PoseWithCovarianceStamped] = []
    transforms: list[TFMessage] = []
    subscribe = client.node.create_subscription
    subscribe(RegionModel, topics.REGION_MODELS, models.append, latched(100))
    subscribe(PoseWithCovarianceStamped, topics.POSE_WITH_COVARIANCE, covariances.append, STREAM)
    subscribe(TFMessage, topics.TF, transforms.append, STREAM)
    camera = Camera(client, reliability=reliability)
    camera.wait(nodes=2)
    statuses = [camera.track(number) for number in range(len(POSES))]
    assert client.spin_until(
        lambda: len(client.poses) == len(POSES) and client.path_stamp_ns == client.last_stamp_ns,
        ANSWER_S,
    )

    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert all(status.odometry_valid for status in statuses)
    assert statuses[-1].frames_received == statuses[-1].frames_tracked == len(POSES)
    assert statuses[-1].frames_dropped == 0
    for stamp, T_map_base in client.poses.items():
        number = round((stamp - NANOSECONDS) / 66_666_667)
        truth = POSES[number] @ inverse(T_BODY_OPTICAL)
        assert np.linalg.norm((inverse(truth) @ T_map_base)[:3, 3]) < 0.01
    refined = client.refined_trajectory(T_BODY_OPTICAL)
    assert len(refined) == len(POSES)

    assert client.spin_until(lambda: client.settled and bool(models), ANSWER_S)
    last = models[-1]
    assert last.map_id == statuses[-1].map_id
    assert stored_region(last).index == (0, 0, 0)
    covariance = np.array(covariances[-1].pose.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert covariances[-1].header.frame_id == "map"

    edges = {
        (t.header.frame_id, t.child_frame_id) for message in transforms for t in message.transforms
    }
    assert edges == {("map", "odom"), ("odom", BASE_FRAME)}
    assert_chain_gives_the_pose(client, transforms)


def assert_chain_gives_the_pose(client: MeslamClient, transforms: list[TFMessage]) -> None:
    """map -> odom -> base of the last frame is what /meslam/pose says."""
    stamp = client.last_stamp_ns
    chain = {
        t.child_frame_id: t
        for message in transforms
        for t in message.transforms
        if stamp_ns(t.header.stamp) == stamp
    }
    product = np.eye(4)
    for child in ("odom", BASE_FRAME):
        moved = chain[child].transform
        T = np.eye(4)
        q = moved.rotation
        T[:3, :3] = rotation(q.x, q.y, q.z, q.w)
        T[:3, 3] = moved.translation.x, moved.translation.y, moved.translation.z
        product = product @ T
    np.testing.assert_allclose(product, client.poses[stamp], atol=1e-9)


def rotation(x: float, y: float, z: float, w: float) -> np.ndarray:
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def test_wheels_take_the_place_of_odometry_in_their_own_frames(start_node, client) -> None:
    """The camera sits aside on a robot whose wheels count in a frame of their own."""
    start_node(TrackingNode, **FAST | {"odometry_topic": "wheels/odom"})
    T_robot_base = exp(np.array([0.3, -0.1, 0.5, 0.0, 0.2, 0.4]))
    T_wheels_map = exp(np.array([-4.0, 7.0, 0.0, 0.0, 0.0, 2.0]))
    kept = StaticBroadcaster(client.node, T_robot_base, "robot", BASE_FRAME)
    wheels = client.node.create_publisher(Odometry, "wheels/odom", qos_profile_sensor_data)
    transforms: list[TFMessage] = []
    client.node.create_subscription(TFMessage, topics.TF, transforms.append, STREAM)
    camera = Camera(client)
    camera.wait()
    assert client.spin_until(lambda: wheels.get_subscription_count() > 0, ANSWER_S), kept
    T_base_robot = inverse(T_robot_base)
    drifted = drifting(Trajectory(np.arange(len(POSES)), np.array(POSES)))
    T_wheels_first = T_wheels_map @ POSES[0] @ inverse(drifted.poses[0])
    for number, pose in enumerate(drifted.poses):
        T_wheels_robot = T_wheels_first @ pose @ inverse(T_BODY_OPTICAL) @ T_base_robot
        message = Odometry(child_frame_id="robot")
        message.header.frame_id = "wheels"
        message.header.stamp = to_stamp(NANOSECONDS + number * PERIOD_NS)
        message.pose.pose = to_pose(T_wheels_robot)
        wheels.publish(message)
    # The image in between is not one of those that the wheels reported for.
    numbers = [0, 2, 5, 8, 10]
    statuses = [camera.track(number, later_ns=number * 1_000_000) for number in numbers]
    assert [status.odometry_valid for status in statuses] == [True] * len(numbers)
    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert client.spin_until(lambda: len(client.poses) == len(numbers), ANSWER_S)
    for stamp, T_map_base in client.poses.items():
        truth = POSES[(stamp - NANOSECONDS) // PERIOD_NS] @ inverse(T_BODY_OPTICAL)
        assert np.linalg.norm((inverse(truth) @ T_map_base)[:3, 3]) < 0.015
    edges = {(t.header.frame_id, t.child_frame_id) for m in transforms for t in m.transforms}
    assert edges == {("map", "wheels")}
    T_map_wheels = from_transform(transforms[-1].transforms[0].transform)
    assert np.linalg.norm((T_map_wheels @ T_wheels_map)[:3, 3]) < 0.1


@pytest.mark.parametrize("topic", ["", "wheels/odom"])
def test_odometry_that_is_started_again_is_no_motion(start_node, client, topic: str) -> None:
    """A killed odometry node, and wheels whose driver is started again, begin at their origin."""
    start_node(TrackingNode, **FAST | {"odometry_topic": topic})
    camera = Camera(client)
    camera.wait()
    name = topic or topics.ODOMETRY

    def odometry(numbers: range) -> Publisher:
        publisher = client.node.create_publisher(Odometry, name, STREAM)
        assert client.spin_until(lambda: publisher.get_subscription_count() == 1, ANSWER_S)
        for number in numbers:
            moved = inverse(POSES[numbers[0]]) @ POSES[number]
            message = Odometry(child_frame_id=BASE_FRAME)
            message.header.frame_id = "odom"
            message.header.stamp = to_stamp(NANOSECONDS + number * PERIOD_NS)
            message.pose.pose = to_pose(T_BODY_OPTICAL @ moved @ inverse(T_BODY_OPTICAL))
            publisher.publish(message)
        return publisher

    first = odometry(range(6))
    statuses = [camera.track(number) for number in range(6)]
    client.node.destroy_publisher(first)
    odometry(range(6, 10))
    statuses += [camera.track(number) for number in range(6, 10)]
    assert [status.odometry_valid for status in statuses] == [True] * 6 + [False] + [True] * 3
    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert client.spin_until(lambda: len(client.poses) == 10, ANSWER_S)
    for stamp, T_map_base in client.poses.items():
        truth = POSES[(stamp - NANOSECONDS) // PERIOD_NS] @ inverse(T_BODY_OPTICAL)
        assert np.linalg.norm((inverse(truth) @ T_map_base)[:3, 3]) < 0.015


@pytest.mark.parametrize("field", ["position", "rotation", "covariance"])
def test_odometry_that_is_none_is_told_and_not_used(start_node, client, field) -> None:
    start_node(TrackingNode, **FAST)
    odometry = client.node.create_publisher(Odometry, topics.ODOMETRY, STREAM)
    camera = Camera(client)
    camera.wait()
    assert client.spin_until(lambda: odometry.get_subscription_count() == 1, ANSWER_S)
    reports = diagnosed(client)
    message = Odometry(child_frame_id=BASE_FRAME)
    message.header.frame_id = "odom"
    message.pose.pose.orientation.w = 1.0
    if field == "position":
        message.pose.pose.position.x = float("nan")
    elif field == "rotation":
        message.pose.pose.orientation.w = 1e-200
    else:
        message.twist.covariance = np.full(36, np.nan)
    for number in range(2):
        message.header.stamp = to_stamp(NANOSECONDS + number * PERIOD_NS)
        odometry.publish(message)
        status = camera.track(number)
        assert status.state == TrackingStatus.OK
        assert not status.odometry_valid
    refused = "0" if field == "covariance" else "2"
    assert client.spin_until(
        lambda: any(
            value.key == "odometry_refused" and value.value == refused
            for report in reports
            for value in report.values
        ),
        ANSWER_S,
    )


def test_only_the_first_image_waits_for_odometry_that_is_silent(start_node, client) -> None:
    """One that was killed counts as a publisher until the middleware notices."""
    timeout_s = 4.0
    start_node(TrackingNode, **FAST | {"odometry_timeout_s": timeout_s})
    odometry = client.node.create_publisher(Odometry, topics.ODOMETRY, STREAM)
    camera = Camera(client)
    camera.wait()
    assert client.spin_until(lambda: odometry.get_subscription_count() == 1, ANSWER_S)
    latencies = [camera.track(number).latency_s for number in range(3)]
    assert latencies[0] >= timeout_s
    assert max(latencies[1:]) < timeout_s
    message = Odometry(child_frame_id=BASE_FRAME)
    message.header.frame_id = "odom"
    for number in (3, 4):
        message.header.stamp = to_stamp(NANOSECONDS + number * PERIOD_NS)
        odometry.publish(message)
    assert camera.track(3).odometry_valid


def test_wheels_that_nothing_connects_to_the_camera_are_named(start_node, client, capfd) -> None:
    start_node(TrackingNode, **FAST | {"odometry_topic": "wheels/odom"})
    wheels = client.node.create_publisher(Odometry, "wheels/odom", STREAM)
    camera = Camera(client)
    camera.wait()
    assert client.spin_until(lambda: wheels.get_subscription_count() > 0, ANSWER_S)
    message = Odometry(child_frame_id="nowhere")
    message.header.stamp = to_stamp(NANOSECONDS)
    wheels.publish(message)
    status = camera.track(0)
    assert status.state == TrackingStatus.OK
    assert not status.odometry_valid
    assert "'nowhere'" in capfd.readouterr().err


def test_a_preset_without_odometry_waits_for_none(start_node, client, capfd) -> None:
    start_node(TrackingNode, **FAST | {"odometry__method": "none"})
    camera = Camera(client)
    camera.wait()
    statuses = [camera.track(number) for number in range(3)]
    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert "odometry" not in capfd.readouterr().err


@pytest.mark.parametrize("give_way", [True, False])
def test_training_gives_way_only_to_pairs_that_wait(start_node, client, give_way: bool) -> None:
    steps = 300
    trained = {"mapping__iterations": steps, "mapping__keyframe_iterations": steps}
    start_node(TrackingNode, **FAST | trained | {"give_way": give_way})
    camera = Camera(client)
    camera.wait()
    # A status tells of the training on the frame before.
    in_lockstep = [camera.track(number).iterations for number in range(3)]
    assert in_lockstep == [FAST["mapping__first_iterations"]] * 2 + [steps]
    numbers = range(3, 9)
    for number in numbers:
        camera.send(number)
    assert client.spin_until(lambda: len(client.statuses) > numbers[-1], ANSWER_S)
    *while_pairs_wait, at_the_end = [status.iterations for status in client.statuses[3:]]
    assert all((taken < steps) == give_way for taken in while_pairs_wait), while_pairs_wait
    assert min(while_pairs_wait) >= MeslamConfig().mapping.min_iterations
    assert at_the_end == steps


def test_tracking_goes_on_without_odometry_and_without_a_base(start_node, client) -> None:
    start_node(TrackingNode, **FAST)
    camera = Camera(client, mounted=False)
    camera.wait()
    statuses = [camera.track(number) for number in range(4)]
    assert all(status.state == TrackingStatus.OK for status in statuses)
    assert not any(status.odometry_valid for status in statuses)
    # The optical frame is the base, and looks along the map's x axis at first.
    first = client.poses[min(client.poses)]
    np.testing.assert_allclose(first, T_BODY_OPTICAL, atol=1e-6)


def test_a_shorter_queue_counts_at_once_and_says_what_it_dropped(start_node, client) -> None:
    node = start_node(TrackingNode, **FAST | {"mapping__iterations": 300, "give_way": False})
    camera = Camera(client)
    camera.wait()
    camera.track(0)
    (result,) = node.set_parameters([Parameter("queue_size", value=1)])
    assert result.successful
    for number in range(1, 8):
        camera.send(number)

    def accounted() -> bool:
        return client.statuses[-1].frames_received == 8

    assert client.spin_until(accounted, ANSWER_S)
    last = client.statuses[-1]
    assert last.frames_dropped > 0
    assert last.frames_tracked == 8 - last.frames_dropped
    assert f"queue full: {last.frames_dropped}" in last.drop_reasons


def test_a_computer_that_is_too_slow_says_so(start_node, client) -> None:
    slow = {"mapping__iterations": 600, "give_way": False, "queue_size": 1}
    start_node(TrackingNode, **FAST | slow)
    reports = diagnosed(client)
    camera = Camera(client)
    camera.wait()
    camera.track(0)
    for number in range(1, 12):
        camera.send(number)
    assert client.spin_until(lambda: client.statuses[-1].frames_received == 12, ANSWER_S)
    last = client.statuses[-1]
    assert last.state == TrackingStatus.DEGRADED
    assert "of the last 12 image pairs were skipped" in last.reason
    assert client.last_stamp_ns in client.poses
    assert client.spin_until(lambda: any("overloaded" in r.message for r in reports), ANSWER_S)


def test_the_effort_of_training_changes_while_it_runs(start_node, client) -> None:
    node = start_node(TrackingNode, **FAST | {"give_way": False})
    camera = Camera(client)
    camera.wait()
    for number in range(3):
        camera.track(number)
    steps = {"mapping.iterations": 21, "mapping.keyframe_iterations": 21}
    results = node.set_parameters([Parameter(name, value=n) for name, n in steps.items()])
    assert all(result.successful for result in results)
    # A status tells of the training on the frame before.
    assert [camera.track(number).iterations for number in (3, 4)][-1] == 21
    client.call(Trigger, topics.RESET)
    fresh = [camera.track(number).iterations for number in range(5, 8)]
    assert fresh[-1] == 21


def test_reset_and_pause(start_node, client) -> None:
    start_node(TrackingNode, **FAST)
    camera = Camera(client)
    camera.wait()
    before = camera.track(0)
    answer = client.call(SetBool, topics.PAUSE, SetBool.Request(data=True))
    assert answer.success
    paused = camera.track(1)
    assert paused.paused
    assert paused.frames_tracked == 1
    client.call(SetBool, topics.PAUSE, SetBool.Request(data=False))
    going_on = camera.track(2)
    assert going_on.map_id == before.map_id
    assert "paused: 1" in going_on.drop_reasons
    assert client.call(Trigger, topics.RESET).success
    after = camera.track(3)
    assert after.map_id != before.map_id
    assert after.frames_tracked == 1


def test_recording_that_starts_again_begins_a_new_map(start_node, client) -> None:
    start_node(TrackingNode, **FAST)
    camera = Camera(client)
    camera.wait()
    first = camera.track(0, later_ns=100 * NANOSECONDS)
    camera.track(1, later_ns=100 * NANOSECONDS)
    jumped = [camera.track(number) for number in range(5)]
    assert all(status.map_id == first.map_id for status in jumped)
    assert "stamp jumps by -100.067 s" in jumped[0].reason
    again = camera.track(5)
    assert again.map_id != first.map_id
    assert again.state == TrackingStatus.OK


@pytest.mark.parametrize("wrong_s", [-1.0, 1e9])
def test_one_wrong_stamp_costs_one_frame_and_not_the_map(start_node, client, wrong_s) -> None:
    """A driver that forgets a stamp, and one that takes it from another clock."""
    start_node(TrackingNode, **FAST)
    camera = Camera(client)
    camera.wait()
    later_ns = 100 * NANOSECONDS
    before = [camera.track(number, later_ns) for number in range(2)][-1]
    wrong = camera.track(2, round(wrong_s * NANOSECONDS))
    assert "believed when the next pairs" in wrong.reason
    after = [camera.track(number, later_ns) for number in range(3, 5)]
    assert all(status.state == TrackingStatus.OK for status in after)
    assert after[-1].map_id == before.map_id
    assert "stamps that jump: 1" in after[-1].drop_reasons
    assert after[-1].frames_tracked == 4


def wrong_encoding(messages: Messages) -> None:
    messages[1].encoding = "bayer_rggb8"


def depth_of_another_size(messages: Messages) -> None:
    depth = messages[2]
    depth.width, depth.step = depth.width // 2, depth.step // 2
    depth.data = byte_array(bytes(depth.data)[: depth.step * depth.height])


def no_intrinsics(messages: Messages) -> None:
    messages[0].k = np.zeros(9)


def other_colour_size(messages: Messages) -> None:
    messages[0].width = 999


def unconnected_depth_frame(messages: Messages) -> None:
    messages[2].header.frame_id = "camera_depth_optical_frame"


def no_frame(messages: Messages) -> None:
    messages[1].header.frame_id = messages[2].header.frame_id = ""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (wrong_encoding, ("color/image_raw", "bayer_rggb8", "rgb8")),
        (depth_of_another_size, ("aligned_depth_to_color", "80x120", "align_depth")),
        (no_intrinsics, ("camera_info", "all zero")),
        (other_colour_size, ("160x120", "999x120")),
        (unconnected_depth_frame, ("camera_depth_optical_frame", OPTICAL_FRAME)),
        (no_frame, ("frame_id",)),
    ],
)
def test_unusable_input_is_named_and_does_no_harm(start_node, client, capfd, change, words) -> None:
    start_node(TrackingNode, **FAST)
    reports = diagnosed(client)
    camera = Camera(client)
    camera.wait()
    camera.send(0, change)
    assert client.spin_until(lambda: bool(client.statuses), ANSWER_S)
    assert words[0] in client.statuses[0].reason
    assert client.statuses[0].state == TrackingStatus.INITIALISING

    def reported() -> bool:
        return any("unusable images: 1" in report.message for report in reports)

    assert client.spin_until(reported, ANSWER_S)
    log = capfd.readouterr().err
    assert all(word in log for word in words), log
    # A camera_info is remembered; the next one must replace it.
    assert camera.track(1).state == TrackingStatus.OK


def test_silence_is_explained(start_node, client, capfd) -> None:
    start_node(TrackingNode, input_timeout_s=0.5)
    client.spin_until(lambda: False, 1.5)
    log = capfd.readouterr().err
    assert "/camera/camera/color/image_raw: no publisher" in log
    assert "/camera/camera/color/camera_info: no publisher" in log
    assert "remap" in log
    driver = CameraDriver(client.node)
    assert client.spin_until(driver.has_subscribers, ANSWER_S)
    client.spin_until(lambda: False, 2.5)
    log = capfd.readouterr().err
    assert "test_client (reliable)" in log
    assert "announced but nothing arrives" in log


def test_depth_of_another_camera_is_registered(start_node, client) -> None:
    """Depth with its own intrinsics and place, as a D435 without align_depth sends it."""
    from meslam_core.camera import PinholeCamera
    from meslam_ros.conversions import camera_to_info, depth_message

    start_node(TrackingNode, **FAST)
    depth_camera = PinholeCamera(128, 96, 100.0, 100.0, 63.5, 47.5)
    T_color_depth = exp(np.array([0.015, 0.0, 0.0, 0.0, 0.0, 0.0]))
    camera = Camera(client)
    depth_frame = "camera_depth_optical_frame"
    kept = StaticBroadcaster(client.node, T_color_depth, OPTICAL_FRAME, depth_frame)
    camera.wait()

    def as_depth_camera(messages: Messages) -> None:
        number = round((stamp_ns(messages[2].header.stamp) - NANOSECONDS) / 66_666_667)
        seen = frame_at(POSES[number] @ T_color_depth, number, depth_camera)
        stamp = to_stamp(stamp_ns(messages[2].header.stamp))
        replaced = depth_message(seen.depth_m, "16UC1", stamp, depth_frame)
        depth = messages[2]
        for field in ("width", "height", "step", "data", "header"):
            setattr(depth, field, getattr(replaced, field))
        camera._driver.depth_info.publish(camera_to_info(depth_camera, stamp, depth_frame))

    assert client.spin_until(
        lambda: camera._driver.depth_info.get_subscription_count() > 0, ANSWER_S
    ), kept
    for number in range(4):
        before = len(client.statuses)
        camera.send(number, as_depth_camera)
        assert client.spin_until(lambda n=before: len(client.statuses) > n, ANSWER_S)
    assert client.statuses[-1].state == TrackingStatus.OK
    last = client.poses[max(client.poses)] @ T_BODY_OPTICAL
    assert np.linalg.norm((inverse(POSES[3]) @ last)[:3, 3]) < 0.02


def test_pose_messages_carry_the_images_stamp(start_node, client) -> None:
    start_node(TrackingNode, **FAST)
    camera = Camera(client)
    camera.wait()
    status = camera.track(0)
    assert client.spin_until(lambda: bool(client.poses), ANSWER_S)
    assert list(client.poses) == [stamp_ns(status.header.stamp)]
    assert status.header.frame_id == "map"
