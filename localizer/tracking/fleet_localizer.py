"""READ FIRST: one camera frame in, every robot's pose out.

    frame -> is the camera well? -> where does it hang? (landmarks, if it moves) -> predict each robot -> cut a region around
    it -> read its marker there (all markers of the whole picture while one is lost) -> find its look (KCF) -> gates ->
    filter -> learn its look -> by how much it may lean -> poses

A marker gives identity, place and heading; the correlation filters follow a robot whose marker is washed out by glare or
covered. Pixels become metres at the depth the robot itself reports: an error of 1 cm there moves a robot 1 m off the
camera's foot by 2.5 mm.

Deterministic: no clock, robots always in the experiment's order. How many threads OpenCV may use is the process's affair.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from localizer.camera_model import PoolView
from localizer.detection.fiducials import MarkerPose, MarkerReader
from localizer.detection.image_regions import Hull, Pixels, Region, cut, whole
from localizer.sources.health import CameraWatch
from localizer.tracking.appearance import Appearance
from localizer.tracking.camera_pose import LandmarkCamera, StillCamera
from localizer.tracking.observation import KCF_NOISE, MARKER_NOISE, Depth, Sight, depths_of
from localizer.tracking.robot_track import RobotTrack, near_pairs
from localizer.tracking.start import start_poses
from localizer.tracking.tilt import Course, LeanLaw
from wire.config.experiment import Experiment
from wire.frames import Array
from wire.messages.messages import CameraHealth, LocalizerStatus, Pose, Track

_SCAN_EVERY = 5  # frames, while a robot is lost: a whole picture costs as much as many regions
_STRANGE_SCANS = 2  # a marker misread once is not misread alike again
_LEARN_EVERY = 4  # frames, robots taking turns: light changes slowly
_LEARNING_RATE = 0.03  # per lesson: follows the light in 7 s, outlives an arm over the robot
_SURE_PEAK = 0.6  # without markers, only a look this certain is learnt from
_REGION_SIGMAS = 3.0
_WIDEST_SIGMA_M = 0.1  # a region never grows beyond this: a scan is cheaper and surer
_TOUCHING = 2.5  # radii between centres: closer than this a correlation may have changed robots
_QUIET = 4.0 / 3.0  # side of the plate over the marker's: a white cell around its six
_LONGEST_STEP_S = 1.0  # a gap in the stamps longer than this counts as one of this length


@dataclass(frozen=True)
class Located:
    """Result of one frame: (robot id, pose) of every robot ever seen, LOST ones included; none while the camera is ill."""

    poses: tuple[tuple[int, Pose], ...]
    status: LocalizerStatus
    view: PoolView  # the mapping of this frame


class Locator:
    """The localizer's core: `step` once per frame, in order. Robots go by index, in the experiment's order."""

    def __init__(self, experiment: Experiment) -> None:
        vehicle, settings = experiment.vehicle, experiment.localizer
        camera, landmarks = experiment.camera, experiment.landmarks
        self._eye = LandmarkCamera(camera, landmarks) if landmarks else StillCamera(camera)
        self._experiment = experiment
        self._ids = experiment.robot_ids
        self.radius_m, self.marker_height_m = vehicle.radius_m, vehicle.marker.height_m
        self._settings = settings
        self._start = start_poses(experiment)
        self._watch = CameraWatch(experiment.camera.size_px, settings.frozen_frames)
        markers = {robot.marker: index for index, robot in enumerate(experiment.robots)}
        self._reader = MarkerReader(vehicle.marker.side_m, markers)
        plate_half_m = _QUIET * vehicle.marker.side_m / 2.0 if settings.markers else 0.0
        hull = Hull(vehicle.radius_m, vehicle.marker.height_m, plate_half_m)
        self._looks = Appearance(len(self._ids), hull, settings.template_px)
        self._landmark_ids = {landmark.id for landmark in landmarks}
        self._strangers: dict[int, int] = {}  # markers of nobody here -> in how many scans running
        self._tracks = [RobotTrack() if settings.markers else RobotTrack.placed(s[[0, 1, 3]]) for s in self._start]
        self._courses: list[Course | None] = [None] * len(self._ids)  # of the tracks, as far as they were measured
        self._lean = LeanLaw.of(vehicle, settings.tilt_sigma_rad, settings.tilt_rad_per_n)
        self._stamp_ns: int | None = None
        self._frames = 0

    def step(self, frame: Pixels, stamp_ns: int, depths_m: Mapping[int, float]) -> Located:
        """Locate every robot in `frame` (height, width) Bayer RGGB, exposed at `stamp_ns` (middle of the exposure).

        `depths_m` holds the depths of robots' centres by id, as far as they reported one.
        """
        self._frames += 1
        camera = self._watch.judge(frame)
        depths = depths_of(self._experiment, self._start[:, 2].tolist(), depths_m)
        self._predict(stamp_ns)
        sights: dict[int, Sight] = {}
        if camera is CameraHealth.OK and not self._watch.repeated:
            self._eye.look(frame)
        if camera is CameraHealth.OK and not self._watch.repeated and self._eye.usable:
            sights = self._look(frame, depths)
            self._read_markers(frame, depths, sights)
            self._find_looks(sights)
            self._doubt_the_near()
            if self._eye.fresh:
                self._learn_looks(sights)
        self._tracks = [track.settled(self._settings.lost_after_s) for track in self._tracks]
        self._judge_courses()
        poses = self._poses(depths, sights) if camera is CameraHealth.OK else ()
        return Located(poses, LocalizerStatus(camera=camera, frames=self._frames, message=self._trouble(camera)), self.view)

    # --- in the order of `step`

    def _predict(self, stamp_ns: int) -> None:
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / 1e9
        self._stamp_ns = stamp_ns
        step_s = min(max(elapsed_s, 0.0), _LONGEST_STEP_S)
        self._eye.wait(step_s)
        self._tracks = [track.advanced(step_s) for track in self._tracks]
        self._courses = [None if course is None else course.advanced(step_s) for course in self._courses]

    def _look(self, frame: Pixels, depths: Sequence[Depth]) -> dict[int, Sight]:
        """A sight of each robot seen before and expected in the picture."""
        places = {i: track.motion.position_m for i, track in enumerate(self._tracks) if track.motion is not None}
        sigmas = {i: track.motion.position_sigma_m for i, track in enumerate(self._tracks) if track.motion is not None}
        return self._sights(frame, depths, places, sigmas)

    def _sights(
        self, frame: Pixels, depths: Sequence[Depth], places: Mapping[int, Array], sigmas_m: Mapping[int, float]
    ) -> dict[int, Sight]:
        plates_m = [depths[i].plate_m for i in places]
        tangents = self.view.tangents(list(places.values()), plates_m)
        sights = {}
        for i, tangent, mapping in zip(places, tangents, self._eye.uncertainty(tangents, plates_m), strict=True):
            sigma_m = sigmas_m[i] + float(np.sqrt(mapping[0, 0] + mapping[1, 1]))
            reach_m = self._looks.reach_m + _REGION_SIGMAS * min(sigma_m, _WIDEST_SIGMA_M)
            region = cut(frame, tangent.pixel, reach_m * tangent.px_per_m)
            if region is not None:
                sights[i] = Sight(i, self.radius_m, depths[i], tangent, mapping, region)
        return sights

    def _read_markers(self, frame: Pixels, depths: Sequence[Depth], sights: dict[int, Sight]) -> None:
        """Give each track its marker. Adds the sights of robots found where they were not expected."""
        if not self._settings.markers:
            return
        scan = self._frames % _SCAN_EVERY == 1 and any(track.state is Track.LOST for track in self._tracks)
        regions = (
            [whole(frame)] if scan else [sight.region for sight in sights.values()] + self._claimed(frame, depths, sights)
        )
        readings = self._reader.read(self.view, regions, np.array([depth.plate_m for depth in depths]))
        if scan:
            strangers = sorted(self._reader.strangers - self._landmark_ids)
            self._strangers = {i: self._strangers.get(i, 0) + 1 for i in strangers}
        strays = [i for i, r in readings.items() if i not in sights or sights[i].distance_m(r.pose) > self.radius_m]
        elsewhere = {i: readings[i].pose[:2] for i in strays}
        sights.update(self._sights(frame, depths, elsewhere, dict.fromkeys(elsewhere, 0.0)))
        for i, track in enumerate(self._tracks):
            if i in readings and i in sights:
                self._tracks[i] = track.read(sights[i].measurement(readings[i].pose, MARKER_NOISE), self.radius_m)
            elif track.motion is not None and self._taken_place(track.motion.position_m, i, readings):
                self._tracks[i] = track.contradicted()

    def _claimed(self, frame: Pixels, depths: Sequence[Depth], sights: Mapping[int, Sight]) -> list[Region]:
        """Regions where markers were read that wait for a second reading, as far as no robot is expected there."""
        claims = {i: track.claim for i, track in enumerate(self._tracks) if track.claim is not None}
        away = {i: c.pose[:2] for i, c in claims.items() if i not in sights or sights[i].distance_m(c.pose) > self.radius_m}
        return [sight.region for sight in self._sights(frame, depths, away, dict.fromkeys(away, _WIDEST_SIGMA_M)).values()]

    def _taken_place(self, position_m: Array, robot: int, readings: Mapping[int, MarkerPose]) -> bool:
        """Another robot's marker was read here: the two would be inside each other."""
        others = (reading.pose[:2] for i, reading in readings.items() if i != robot)
        return any(float(np.linalg.norm(other - position_m)) < self.radius_m for other in others)

    def _find_looks(self, sights: Mapping[int, Sight]) -> None:
        """The correlation filters, for every robot whose look is known: they bridge a missing marker. Where a marker was
        read they only report their peak, so that its fall is seen before it is needed."""
        seen = [sight for sight in sights.values() if self._looks.knows(sight.robot)]
        matches = self._looks.find(seen, [self._believed(sight.robot) for sight in seen])
        for sight, match in zip(seen, matches, strict=True):
            track = self._tracks[sight.robot]
            clear = self._clearance_m(sight.robot, match.pose) > self.radius_m and sight.shows(match.pose)
            measurement = sight.measurement(match.pose, KCF_NOISE, match.peak)
            self._tracks[sight.robot] = track.found(measurement, self._settings.min_peak) if clear else track

    def _doubt_the_near(self) -> None:
        for pair in near_pairs(self._tracks, _TOUCHING * self.radius_m):
            for i in pair:
                self._tracks[i] = self._tracks[i].doubted()

    def _learn_looks(self, sights: Mapping[int, Sight]) -> None:
        """From sights whose place is certain, with no other robot in the patch."""
        due = [s for i, s in sights.items() if (self._frames + i) % _LEARN_EVERY == 0 or not self._looks.knows(i)]
        apart_m = self._looks.reach_m + self.radius_m
        certain = [s for s in due if self._certain(s.robot) and self._clearance_m(s.robot, self._believed(s.robot)) > apart_m]
        self._looks.learn(certain, [self._believed(sight.robot) for sight in certain], _LEARNING_RATE)

    def _judge_courses(self) -> None:
        """How the robots move, for their lean."""
        for i, track in enumerate(self._tracks):
            if track.measured is None:
                continue
            place_m, course = track.measured.pose[:2], self._courses[i]
            if course is None:
                self._courses[i] = Course.begin(place_m, 0.0)
            elif np.linalg.norm(place_m - course.position_m) > self.radius_m:  # it was carried, or was somebody else
                self._courses[i] = Course.begin(place_m, course.swung_rad)
            else:
                self._courses[i] = course.measured(place_m, self._lean)

    def _poses(self, depths: Sequence[Depth], sights: Mapping[int, Sight]) -> tuple[tuple[int, Pose], ...]:
        messages = []
        for i, (robot, track, depth) in enumerate(zip(self._ids, self._tracks, depths, strict=True)):
            down = sights[i].tangent.jacobian[:, 2] if i in sights else np.zeros(2)
            messages.append((robot, track.message(depth.centre_m, self._lean.covariance(self._courses[i], down))))
        return tuple((robot, pose) for robot, pose in messages if pose is not None)

    def _trouble(self, camera: CameraHealth) -> str:
        """One line for the operator; empty when all is well."""
        if camera is not CameraHealth.OK:
            return f"camera {camera.name.lower().replace('_', ' ')}"
        pairs = list(zip(self._ids, self._tracks, strict=True))
        lost = [str(i) for i, track in pairs if track.state is Track.LOST]
        doubted = [str(i) for i, track in pairs if track.state is not Track.LOST and not track.verified]
        strange = [str(i) for i, scans in self._strangers.items() if lost and scans >= _STRANGE_SCANS]
        parts = (
            ("lost: robot", lost),
            ("identity not verified: robot", doubted),
            ("in view, but no robot's: marker", strange),
        )
        said = [f"{what} {', '.join(ids)}" for what, ids in parts if ids]
        return "; ".join([self._eye.trouble, *said] if self._eye.trouble else said)

    # --- small questions

    @property
    def view(self) -> PoolView:
        """The newest mapping between pixels and pool."""
        return self._eye.view

    def _believed(self, robot: int) -> Array:
        """[x, y, yaw]: this frame's measurement, or the prediction."""
        track = self._tracks[robot]
        if track.measured is not None:
            return track.measured.pose
        return np.zeros(3) if track.motion is None else track.motion.mean[:3]

    def _certain(self, robot: int) -> bool:
        track = self._tracks[robot]
        if self._settings.markers:
            return track.state is Track.MARKER and track.measured is not None and track.verified
        return not self._looks.knows(robot) or (track.measured is not None and track.peak > _SURE_PEAK)

    def _clearance_m(self, robot: int, pose: Array) -> float:
        """Distance from a place to the nearest other robot."""
        others = (t.motion.position_m for i, t in enumerate(self._tracks) if i != robot and t.motion is not None)
        return min((float(np.linalg.norm(other - pose[:2])) for other in others), default=float("inf"))
