"""`tracking_node`: images and odometry to the pose in the map and the regions' networks."""

from __future__ import annotations

import sys
import time
from typing import Any

from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped
from std_srvs.srv import SetBool, Trigger

from meslam_core import se3
from meslam_core.config import MeslamConfig
from meslam_core.errors import FrameError, MapError
from meslam_core.frame import RgbdFrame
from meslam_core.slam import FrameResult, TrackingState
from meslam_core.threads import limit_threads
from meslam_interfaces.msg import RegionIndex, TrackingStatus
from meslam_interfaces.srv import UseMap
from meslam_ros import topics
from meslam_ros.diagnostics import DIAGNOSTICS_PERIOD_S, Diagnostics, counts
from meslam_ros.frame_worker import FrameWorker
from meslam_ros.given_map import GivenMap, Preparation
from meslam_ros.image_synchronizer import ImagePair
from meslam_ros.managed_node import ManagedNode, run
from meslam_ros.map_to_odom import MapToOdom
from meslam_ros.mapping_session import MappingSession
from meslam_ros.model_publisher import ModelPublisher
from meslam_ros.node_settings import FrameSettings, InputSettings, TrackingSettings
from meslam_ros.odometry_source import OdometrySource
from meslam_ros.parameters import declare_config, declare_settings, read_config
from meslam_ros.path_publisher import PathPublisher
from meslam_ros.qos import STREAM
from meslam_ros.rgbd_input import STEADY
from meslam_ros.tracking_messages import (
    covariance_message,
    header,
    health,
    pose_message,
    status_message,
)
from meslam_ros.transforms import CameraMount

FLUSHING_S = 10.0


class TrackingNode(ManagedNode):
    """Runs the pipeline in a worker of its own; the executor only takes messages and answers."""

    def __init__(self, **options: Any) -> None:
        super().__init__("tracking_node", **options)
        self._frames = declare_settings(self, FrameSettings)
        self._inputs = declare_settings(self, InputSettings)
        self._settings = declare_settings(self, TrackingSettings)
        self._config = declare_config(self, MeslamConfig().to_mapping(), self._change_steps)

    def configure(self) -> None:
        self._config = read_config(self)
        limit_threads(self._config.runtime.threads, load_open3d=False)
        frames, settings = self._frames, self._settings
        self._pose = self.create_publisher(PoseStamped, topics.POSE, STREAM)
        self._covariance = self.create_publisher(
            PoseWithCovarianceStamped, topics.POSE_WITH_COVARIANCE, STREAM
        )
        self._path = PathPublisher(self, frames.map_frame, lambda: settings.path_period_s)
        self._status = self.create_publisher(TrackingStatus, topics.STATUS, STREAM)
        self._diagnostics = Diagnostics(self)
        self._models = ModelPublisher(
            self, frames.map_frame, self._config.map.codec, lambda: settings.model_period_s
        )
        self._map_to_odom = MapToOdom(
            self, frames.map_frame, frames.odom_frame, lambda: settings.transform_rate_hz
        )
        self._odometry = OdometrySource(
            self,
            settings.odometry_topic,
            frames.odom_frame,
            self._config.odometry,
            lambda: settings.odometry_timeout_s,
        )
        self._reset = self.create_service(Trigger, topics.RESET, self._on_reset)
        self._pause = self.create_service(SetBool, topics.PAUSE, self._on_pause)
        self._use = self.create_service(UseMap, topics.USE_MAP, self._on_use_map)
        self._given: Preparation | None = None
        self._paused = False
        self._reset_requested = False
        self._begin()

    def activate(self) -> None:
        self._worker = FrameWorker(
            self, self._inputs, self._frames, lambda: self._settings.queue_size, self
        )
        self._timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._diagnose, clock=STEADY)

    def deactivate(self) -> None:
        self.destroy_timer(self._timer)
        self._worker.close()
        self._session.wait()

    def cleanup(self) -> None:
        self._models.close()
        self._map_to_odom.close()
        self._diagnostics.close()
        self._odometry.close()
        self._path.close()
        for service in (self._reset, self._pause, self._use):
            self.destroy_service(service)
        for publisher in (self._pose, self._covariance, self._status):
            self.destroy_publisher(publisher)

    def _begin(self, session: MappingSession | None = None) -> None:
        """Start with an empty map, or with the one of a session."""
        self._session = session or self._make_session()
        self._reset_requested = False
        self._all_published = True
        self._path.begin()
        self._models.begin(self._session.map_id)
        self._map_to_odom.reset()

    def _begin_anew(self, session: MappingSession | None = None) -> None:
        """Give up the map; what still trains it comes to its end first."""
        self._session.wait()
        self._begin(session)

    def _make_session(self, given: GivenMap | None = None) -> MappingSession:
        continuation = given.continuation if given else None
        return MappingSession(self._config, self._settings.seed, self._frames_wait, continuation)

    def _take_given(self) -> None:
        """Go over to a given map that is ready."""
        given = self._given
        if given is None or not given.ended:
            return
        self._given = None
        session = given.session(self._session.T_map_base)
        if session is None:
            self.get_logger().error(f"the given map cannot be used: {given.error}")
            return
        self._begin_anew(session)
        doing = "poses are found in" if session.localises else "mapping goes on in"
        self.get_logger().info(f"{doing} the stored map {session.map_id}")

    def _change_steps(self, config: MeslamConfig) -> None:
        if self.configured:
            self._config = config
            self._session.change_steps(config.mapping)

    def _frames_wait(self) -> bool:
        return self._settings.give_way and self._worker.waiting > 0

    def restart(self, reason: str) -> None:
        """Begin a new map, or anew in one that is not trained (`FrameConsumer`)."""
        localised = self._session if self._session.localises else None
        begins = "localisation begins anew" if localised else "a new map begins"
        self.get_logger().warn(f"{reason}; {begins}")
        self._begin_anew(localised.again() if localised else None)

    def process(self, frame: RgbdFrame, mount: CameraMount, pair: ImagePair) -> None:
        """Track, map and publish one frame (`FrameConsumer`)."""
        if self._reset_requested:
            self._begin_anew()
        self._take_given()
        session = self._session
        if self._paused:
            session.discarded["paused"] += 1
            self.refuse(pair, "paused")
            return
        odometry = self._odometry.estimate(frame, mount, self._worker.input.transforms)
        result = session.track(frame, mount, odometry)
        if session.has_pose:
            self._publish_pose(result)
        latency_s = time.monotonic() - pair.arrival_s
        session.wait()
        self._models.offer(session.regions, session.mapped_ns)
        head = header(frame.stamp_ns, self._frames.map_frame)
        self._publish_status(status_message(session.map(), head), latency_s)
        self._all_published = False
        self._path.offer(session)
        if session.wants_new_map:
            self.restart("the camera has been lost for too long")

    def refuse(self, pair: ImagePair, reason: str) -> None:
        """Tell that a pair was not tracked, and why (`FrameConsumer`)."""
        result = self._session.result
        state = result.state if result else TrackingState.INITIALISING
        if state == TrackingState.OK and not self._paused:
            state = TrackingState.DEGRADED
        self._publish_status(
            TrackingStatus(
                header=header(pair.stamp_ns, self._frames.map_frame),
                state=int(state),
                reason=reason,
            ),
            time.monotonic() - pair.arrival_s,
        )

    def idle(self, silence_s: float) -> None:
        """Refine the map, then publish what the bounded rates held back (`FrameConsumer`)."""
        if self._reset_requested:
            self._begin_anew()
        self._take_given()
        if self._all_published or silence_s < self._settings.idle_s:
            return
        if self._session.refine():
            return
        self._all_published = True
        self._session.wait()
        self._models.offer(self._session.regions, self._session.mapped_ns, final=True)
        self._path.publish(self._session)
        if not self._models.flush(FLUSHING_S):
            self.get_logger().warn("the last region models are still being encoded")
        self._latest_status.settled = True
        self._latest_status.map_bytes = self._models.map_bytes
        self._status.publish(self._latest_status)

    def _publish_pose(self, result: FrameResult) -> None:
        head = header(result.stamp_ns, self._frames.map_frame)
        T_map_camera, odometry = result.T_map_camera, result.odometry
        T_map_base = T_map_camera @ self._session.T_camera_base
        self._pose.publish(pose_message(T_map_base, head))
        self._covariance.publish(
            covariance_message(T_map_base, result.covariance, T_map_camera, head)
        )
        T_map_odom = None
        if odometry is not None:
            T_map_odom = T_map_camera @ se3.inverse(odometry.T_odom_camera)
        self._map_to_odom.update(result.stamp_ns, T_map_odom, self._odometry.odom_frame)

    def _publish_status(self, status: TrackingStatus, latency_s: float) -> None:
        """Add what the node counts to what is known of a frame, and publish it."""
        session = self._session
        dropped = self._worker.dropped + session.discarded
        status.map_id = session.map_id
        status.keyframes = session.keyframes
        status.working_region = session.working_region
        status.training_regions = [RegionIndex(index=i) for i in session.training_regions]
        status.map_bytes = self._models.map_bytes
        status.latency_s = latency_s
        status.frames_tracked = session.tracked
        status.frames_dropped = dropped.total()
        status.frames_received = session.received + dropped.total()
        status.drop_reasons = counts(dropped + self._worker.input.lost)
        status.queue_length = self._worker.waiting
        status.paused = self._paused
        status.localising = session.localises
        if status.state == TrackingStatus.OK and self._worker.overload:
            # The pose is as good as ever, but there are not as many as the camera would give.
            status.state, status.reason = TrackingStatus.DEGRADED, self._worker.overload
        self._latest_status = status
        self._status.publish(status)

    def _on_reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._reset_requested = True
        self._given = None
        response.success = True
        response.message = "the map is forgotten; a new one begins with the next image"
        self.get_logger().info(response.message)
        return response

    def _on_use_map(self, request: UseMap.Request, response: UseMap.Response) -> UseMap.Response:
        try:
            given = GivenMap.of(request, self._config)
        except FrameError as error:
            response.result, response.message = response.INVALID_REQUEST, str(error)
            return response
        except MapError as error:
            response.result, response.message = response.INVALID_DATA, str(error)
            return response
        session = self._session
        self._given = Preparation(given, self._make_session, session.T_map_base, session.map_id)
        response.result = response.SUCCESS
        response.message = (
            f"tracking goes over to the map {given.map_id} when it is ready; the map_id in "
            f"{topics.STATUS} tells"
        )
        self.get_logger().info(response.message)
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._paused = request.data
        response.success = True
        response.message = "paused: images are discarded" if request.data else "going on"
        self.get_logger().info(response.message)
        return response

    def _diagnose(self) -> None:
        session, worker = self._session, self._worker
        result, dropped = session.result, counts(worker.dropped + session.discarded)
        self._diagnostics.report(
            *health(result, dropped, worker.overload),
            {
                "state": result.state.name if result else "INITIALISING",
                "frames_tracked": session.tracked,
                "dropped": dropped or "none",
                "lost": counts(worker.input.lost) or "none",
                "odometry_refused": self._odometry.refused,
                "queue_length": worker.waiting,
                "keyframes": session.keyframes,
                "regions": len(session.regions),
                "tracking_ms": round(result.tracking_ms, 1) if result else 0.0,
                "mapping_ms": round(result.mapping_ms, 1) if result else 0.0,
                "map_bytes": self._models.map_bytes,
            },
        )


def main() -> None:
    """Entry point."""
    sys.exit(run(TrackingNode))


if __name__ == "__main__":
    main()
