"""READ FIRST: the localizer's core: one camera frame in, the pose of every robot out.

    locate: frame -> camera health -> camera pose (landmarks, if it moves) -> predict each robot -> cut a region around it ->
            read its marker there -> match its appearance (KCF) if that failed -> gates -> Kalman filter -> tilt -> poses
    finish: look for lost robots (one strip of the picture for markers; appearances where they were lost) -> correlation peak
            and update of the appearances whose turn it is

The poses of a frame need `locate` alone. What `finish` finds shows in the next frame's poses: the peak of a robot whose marker
was read, a lost robot whose appearance was matched, the claim of a marker that was found elsewhere.

A marker gives identity, position and heading. The correlation filters follow a robot whose marker is washed out by glare or
covered. Pixels become metres at the depth that the robot itself reports: an error of 1 cm there moves a robot 1 m off the
camera's foot by 2.5 mm.

Deterministic: no clock, robots always in the experiment's order. The number of OpenCV's threads is the process's affair.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.interpolate import CubicSpline

from localizer.camera_model import RefractiveCamera
from localizer.detection.fiducials import MarkerPose, MarkerReader
from localizer.detection.image_regions import ImageRegion, Pixels, RobotShape, cut, whole
from localizer.sources.health import FrameHealthMonitor
from localizer.tracking.appearance import LEARNT_AT_MARKERS, LEARNT_AT_MATCHES, AppearanceModel
from localizer.tracking.camera_pose import CameraPoseTracker, FixedCameraPose
from localizer.tracking.check_marks import CheckedCameraPose
from localizer.tracking.depth_memory import DepthMemory
from localizer.tracking.observation import Depth, PredictedView, depths_of
from localizer.tracking.plausibility import AttitudeCheck, BasinGate, MarkerSizes, TwinMarkers
from localizer.tracking.robot_track import RobotTrack, close_pairs
from localizer.tracking.tilt import Attitude, LeanReader, MotionEstimate, TiltModel, body_to_level
from shoal.config.experiment import Experiment
from shoal.config.scene import Circle, PathSpec, Route
from shoal.frames import Array
from shoal.messages.messages import CameraHealth, LocalizerStatus, Pose, Track

_STRIPS = 5  # frames in which the whole picture is scanned while a robot is lost, a strip in each (3 ms); more find it later
_TWINS_EVERY = 5  # frames between strips that are scanned while no robot is lost, for a second marker of one id
_STRANGE_SCANS = 2  # scans in a row that must show a foreign marker before it is told; a misreading does not repeat
_CHECK_EVERY = 2  # frames between checks of a board's attitude, 2 ms each, which no pose waits for
_LEARN_EVERY = 4  # frames between updates (and peaks) of an appearance, robots taking turns: light changes slowly
_LEARNING_RATE = 0.03  # per update: follows the light in 7 s, and is slow enough for an arm over the robot
_SURE_PEAK = 0.6  # correlation peak; without markers, only better matches update the appearance
_REGION_SIGMAS = 3.0
_WIDEST_SIGMA_M = 0.1  # m, standard deviation at which a region stops growing: beyond it a scan is cheaper and surer
_TOUCHING = 2.5  # robot radii between centres; closer than this a correlation may have changed robots
_OVERLAP_SIDES = 2.0  # of a marker, between strips: its diagonal and its white cell, at any heading
_QUIET = 4.0 / 3.0  # side of the plate over the marker's: a white cell around its six
_NOT_MEASURED: Mapping[int, Attitude] = MappingProxyType({})
_LONGEST_STEP_S = 1.0  # s; over a longer gap between stamps motion is predicted as over this long


@dataclass(frozen=True)
class LocalizationResult:
    """The result of one frame: (robot id, pose) of every robot ever seen, LOST ones included; no poses while the camera
    fails."""

    poses: tuple[tuple[int, Pose], ...]
    status: LocalizerStatus
    view: RefractiveCamera  # this frame's mapping between pixels and pool


@dataclass(frozen=True)
class _Located:
    """A frame that was located and not finished: what `finish` needs of it. `views` is empty if nothing could be seen."""

    frame: Pixels
    depths: tuple[Depth, ...]
    views: Mapping[int, PredictedView]
    reported: frozenset[int]  # robots whose boards reported their attitude


class FleetLocalizer:
    """The tracker of all robots: call `locate` and then `finish` once per frame, in order; `step` is both. Robots go by
    index, in the experiment's order."""

    def __init__(self, experiment: Experiment, sees_all: bool = True) -> None:
        """`sees_all` is False for one of several cameras: a robot that its picture does not show is no trouble then."""
        self._sees_all = sees_all
        vehicle, settings = experiment.vehicle, experiment.localizer
        camera = experiment.camera
        self._camera_pose = _camera_pose(experiment)
        self._experiment = experiment
        self._ids = experiment.robot_ids
        self.radius_m, self.marker_height_m = vehicle.radius_m, vehicle.marker.height_m
        self._side_m, self._settings = vehicle.marker.side_m, settings
        self._start = start_poses(experiment)
        self._depths = DepthMemory(experiment, self._start[:, 2].tolist())
        self._watch = FrameHealthMonitor(experiment.camera.size_px, settings.frozen_frames)
        markers = {robot.marker: index for index, robot in enumerate(experiment.robots)}
        self._reader = MarkerReader(vehicle.marker.side_m, markers, settings.marker_family)
        self._gate = BasinGate(experiment)
        self._outside_frames: dict[int, int] = {}  # robot -> last frame in which its marker was read where no robot can be
        self._overlap_px = round(
            _OVERLAP_SIDES * vehicle.marker.side_m * max(camera.focal_px) / abs(camera.position_m[2])
        )  # between strips; deeper markers look smaller
        self._plate_reach_m = np.sqrt(0.5) * _QUIET * vehicle.marker.side_m  # half the diagonal of the white plate
        plate_half_m = _QUIET * vehicle.marker.side_m / 2.0 if settings.markers else 0.0
        hull = RobotShape(vehicle.radius_m, vehicle.marker.height_m, plate_half_m)
        self._appearance = AppearanceModel(
            len(self._ids), hull, settings.template_px, LEARNT_AT_MARKERS if settings.markers else LEARNT_AT_MATCHES
        )
        self._landmark_ids = {mark.id for mark in experiment.marks}
        self._twins, self._sizes = TwinMarkers(vehicle.radius_m), MarkerSizes(len(self._ids))
        self._foreign_scans: dict[int, int] = {}  # id of a foreign marker -> scans in a row
        self._foreign_ids: set[int] = set()  # in the strips of the present scan
        self._tracks = [RobotTrack() if settings.markers else RobotTrack.at_start(s[[0, 1, 3]]) for s in self._start]
        self._motions: list[MotionEstimate | None] = [None] * len(self._ids)  # of the tracks, as far as they were measured
        self._tilt = TiltModel.of(vehicle, settings.tilt_sigma_rad, settings.tilt_rad_per_n)
        self._attitudes: list[Attitude | None] = [None] * len(self._ids)  # at the present exposure
        self._leans_before = self._attitudes  # in the frame before
        self._attitude_check = AttitudeCheck(len(self._ids))
        self._lean_reader = LeanReader(vehicle) if settings.markers else None
        self._reads_leans = settings.tilt_from_outline and settings.markers
        self._stamp_ns: int | None = None
        self._frames = 0
        self._located: _Located | None = None

    def step(
        self, frame: Pixels, stamp_ns: int, depths_m: Mapping[int, float], attitudes: Mapping[int, Attitude] = _NOT_MEASURED
    ) -> LocalizationResult:
        """`locate` and `finish`, for callers to whom the time to the poses does not matter."""
        result = self.locate(frame, stamp_ns, depths_m, attitudes)
        self.finish()
        return result

    def locate(
        self, frame: Pixels, stamp_ns: int, depths_m: Mapping[int, float], attitudes: Mapping[int, Attitude] = _NOT_MEASURED
    ) -> LocalizationResult:
        """Localize every robot in `frame` (height, width) Bayer RGGB, exposed at `stamp_ns` (middle of the exposure).

        `depths_m` holds the depths of robots' centres by id, as far as they reported one, `attitudes` their roll and pitch at
        the exposure.
        """
        self._frames += 1
        self._located = None
        camera = self._watch.assess(frame)
        depths = depths_of(self._experiment, self._depths.update(depths_m, stamp_ns), attitudes)
        self._leans_before = self._attitudes if self._reads_leans else [None] * len(self._ids)
        self._attitudes = [attitudes.get(robot) for robot in self._ids]
        self._predict(stamp_ns)
        views: dict[int, PredictedView] = {}
        if camera is CameraHealth.OK and not self._watch.repeated:
            self._camera_pose.update(frame)
            if self._camera_pose.usable:
                views = self._predict_views(frame, depths)
                self._read_markers(frame, depths, views)
                self._match_appearance([v for i, v in views.items() if self._needs_match(i)])
                self._read_leans(frame, views)
                self._doubt_close_pairs()
                reported = frozenset(i for i, robot in enumerate(self._ids) if robot in attitudes)
                self._located = _Located(frame, depths, views, reported)
        tracks = [track.end_of_frame(self._settings.lost_after_s) for track in self._tracks]
        self._tracks = [track.lost() if self._coasts_outside(track) else track for track in tracks]
        self._estimate_motion()
        poses = self._poses(depths, views) if camera is CameraHealth.OK else ()
        status = LocalizerStatus(
            camera=camera,
            frames=self._frames,
            message=self._status_message(camera),
            moved=self._camera_pose.moved,
            marks_seen=self._camera_pose.marks_seen,
        )
        return LocalizationResult(poses, status, self.view)

    def finish(self) -> None:
        """Do what the poses of the frame last located need not wait for. A second call does nothing."""
        located, self._located = self._located, None
        if located is None:
            return
        self._match_appearance([v for i, v in located.views.items() if self._is_lost(i)])
        self._scan(located)
        self._check_attitude(located)
        if self._camera_pose.fresh:
            self._update_appearance(located.views)

    # --- in the order of `locate` and `finish`

    def _predict(self, stamp_ns: int) -> None:
        """Advance camera pose, tracks and motion estimates to this exposure."""
        elapsed_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / 1e9
        self._stamp_ns = stamp_ns
        step_s = min(max(elapsed_s, 0.0), _LONGEST_STEP_S)
        self._camera_pose.advance(step_s)
        self._tracks = [track.predicted(step_s, max(elapsed_s, 0.0)) for track in self._tracks]
        self._motions = [None if motion is None else motion.predicted(step_s) for motion in self._motions]

    def _predict_views(self, frame: Pixels, depths: Sequence[Depth]) -> dict[int, PredictedView]:
        """A predicted view of each robot seen before and expected in the picture."""
        places = {i: track.motion.position_m for i, track in enumerate(self._tracks) if track.motion is not None}
        sigmas = {i: track.motion.position_sigma_m for i, track in enumerate(self._tracks) if track.motion is not None}
        return self._views_at(frame, depths, places, sigmas)

    def _views_at(
        self, frame: Pixels, depths: Sequence[Depth], places: Mapping[int, Array], sigmas_m: Mapping[int, float]
    ) -> dict[int, PredictedView]:
        """Views of robots, by index, at `places` (2,) in the pool with standard deviations `sigmas_m`: each with the region of
        the picture in which to look for it. A robot whose place is not in the picture has no view."""
        plates_m = [depths[i].plate_m for i in places]
        tangents = self.view.linearize(list(places.values()), plates_m)
        covariances = self._camera_pose.uncertainty(tangents, plates_m)
        views, slope_rad, tilts_rad = {}, self._settings.surface_slope_rad, self._tilts_rad()
        for i, tangent, camera_covariance in zip(places, tangents, covariances, strict=True):
            camera_sigma_m = float(np.sqrt(camera_covariance[0, 0] + camera_covariance[1, 1]))
            margin_m = _REGION_SIGMAS * min(sigmas_m[i] + camera_sigma_m, _WIDEST_SIGMA_M)
            region = cut(frame, tangent.pixel, (self._appearance.reach_m + margin_m) * tangent.px_per_m)
            plate = cut(frame, tangent.pixel, (self._plate_reach_m + margin_m) * tangent.px_per_m)
            if region is not None:
                views[i] = PredictedView(
                    i,
                    self.radius_m,
                    depths[i],
                    body_to_level(*tilts_rad[i]),
                    slope_rad,
                    tangent,
                    camera_covariance,
                    region,
                    plate or region,
                )
        return views

    def _read_markers(self, frame: Pixels, depths: Sequence[Depth], views: dict[int, PredictedView]) -> None:
        """Give each track its marker. Adds the views of robots that were found elsewhere than expected.

        A marker that was read in the last frame is looked for where the plate is expected, at half the cost, and then like
        the others in the robot's whole region. The regions of lost robots are left to `finish`.
        """
        if not self._settings.markers:
            return
        plates_m, tilts_rad = np.array([depth.plate_m for depth in depths]), self._tilts_rad()
        plates = [view.plate for i, view in views.items() if self._tracks[i].state is Track.MARKER]
        readings = self._read(plates, plates_m, tilts_rad)
        missed = [view.region for i, view in views.items() if i not in readings and not self._is_lost(i)]
        claims = self._claim_regions(frame, depths, views)
        readings = self._read(missed + claims, plates_m, tilts_rad) | readings
        strays = [i for i, r in readings.items() if i not in views or views[i].distance_m(r.pose) > self.radius_m]
        elsewhere = {i: readings[i].pose[:2] for i in strays}
        views.update(self._views_at(frame, depths, elsewhere, dict.fromkeys(elsewhere, 0.0)))
        for i, track in enumerate(self._tracks):
            if i in readings and i in views:
                reading = views[i].marker(readings[i], self._side_m, self._settings.corner_sigma_px)
                self._sizes.note(i, readings[i].size)
                measurement = track.at_stamp(reading, self._late_s(views[i]))
                self._tracks[i] = track.with_marker(measurement, self.radius_m)
            elif track.motion is not None and self._is_occupied(track.motion.position_m, i, readings):
                self._tracks[i] = track.contradicted()
            if self._twins.is_twin(i, self._frames):
                self._tracks[i] = self._tracks[i].unverified()

    def _read(self, regions: Sequence[ImageRegion], plates_m: Array, tilts_rad: Array) -> dict[int, MarkerPose]:
        """Markers by robot in regions of the picture, those left out that lie where no robot can be."""
        markers = self._reader.read(self.view, regions, plates_m, tilts_rad)
        for i, size in self._reader.strange_sizes.items():
            if i not in markers and self._is_lost(i):
                self._sizes.note_strange(i, size, self._frames)
        chosen: dict[int, MarkerPose] = {}
        for i, readings in markers.items():
            inside = [r for r in readings if self._gate.admits(self.view, r.pose[:2], float(plates_m[i]))]
            if not inside:
                self._outside_frames[i] = self._frames
                continue
            poses = [reading.pose for reading in inside]
            self._twins.note(i, poses, self._frames)
            has_twin = self._twins.are_apart(poses) or self._twins.is_twin(i, self._frames)
            near = self._near_track(i, inside)
            if near or not has_twin:  # of two plates with one number only that on the track is the robot's
                chosen[i] = min(near or inside, key=lambda reading: reading.misfit)
        return chosen

    def _near_track(self, robot: int, readings: Sequence[MarkerPose]) -> list[MarkerPose]:
        """Those of a robot's readings that are where it is followed to."""
        motion = self._tracks[robot].motion
        if motion is None or self._is_lost(robot):
            return []
        return [r for r in readings if math.dist(r.pose[:2], motion.position_m) <= self.radius_m]

    def _claim_regions(self, frame: Pixels, depths: Sequence[Depth], views: Mapping[int, PredictedView]) -> list[ImageRegion]:
        """Regions around claims (markers read once) of lost robots, and where their robot is not expected."""
        claims = {i: track.claim for i, track in enumerate(self._tracks) if track.claim is not None}
        away = {
            i: claim.pose[:2]
            for i, claim in claims.items()
            if i not in views or self._is_lost(i) or views[i].distance_m(claim.pose) > self.radius_m
        }
        return [view.region for view in self._views_at(frame, depths, away, dict.fromkeys(away, _WIDEST_SIGMA_M)).values()]

    def _is_occupied(self, position_m: Array, robot: int, readings: Mapping[int, MarkerPose]) -> bool:
        """True if another robot's marker was read here: the two would be inside each other."""
        others = (reading.pose[:2] for i, reading in readings.items() if i != robot)
        return any(math.dist(other, position_m) < self.radius_m for other in others)

    def _needs_match(self, robot: int) -> bool:
        """True for a followed robot whose marker was not read."""
        return self._tracks[robot].measured is None and not self._is_lost(robot)

    def _match_appearance(self, views: Sequence[PredictedView]) -> None:
        """Give each view's track the match of its appearance, if that is known."""
        known_views = [view for view in views if self._appearance.is_initialised(view.robot)]
        matches = self._appearance.match(known_views, [self._best_pose(view.robot) for view in known_views])
        for view, match in zip(known_views, matches, strict=True):
            track = self._tracks[view.robot]
            alone = self._clearance_m(view.robot, match.pose) > self.radius_m
            clear = alone and view.shows(match.pose) and self._gate.admits(self.view, match.pose[:2], view.depth.plate_m)
            measurement = view.measurement(match.pose, self._appearance.recognition.noise, match.covariance, match.peak)
            dated = track.at_stamp(measurement, self._late_s(view))
            self._tracks[view.robot] = track.with_match(dated, self._settings.min_peak) if clear else track

    def _read_leans(self, frame: Pixels, views: Mapping[int, PredictedView]) -> None:
        """Read the lean of each robot that was measured in this frame and whose board has not reported its attitude."""
        if self._lean_reader is None or not self._reads_leans:
            return
        for i, view in views.items():
            measured = self._tracks[i].measured
            if measured is None or self._attitudes[i] is not None:
                continue
            plate = self._tracks[i].at_row(measured.pose, self._late_s(view))
            self._attitudes[i] = self._lean_reader.read(
                self.view, frame, view.tangent, plate, view.depth.centre_m, self._settings.surface_slope_rad
            )

    def _check_attitude(self, located: _Located) -> None:
        """Hold the attitude that one robot's board reports against the lean of its hull; robots take turns."""
        if self._frames % _CHECK_EVERY:
            return
        robot = self._frames // _CHECK_EVERY % len(self._ids)
        view, attitude = located.views.get(robot), self._attitudes[robot]
        measured = self._tracks[robot].measured
        if self._lean_reader is None or attitude is None:
            return
        if view is None or measured is None or robot not in located.reported:
            return
        plate = self._tracks[robot].at_row(measured.pose, self._late_s(view))
        slope_rad = self._settings.surface_slope_rad
        lean = self._lean_reader.read(self.view, located.frame, view.tangent, plate, view.depth.centre_m, slope_rad)
        if lean is not None:
            self._attitude_check.note(robot, attitude, lean)

    def _doubt_close_pairs(self) -> None:
        for pair in close_pairs(self._tracks, _TOUCHING * self.radius_m):
            for i in pair:
                self._tracks[i] = self._tracks[i].identity_doubted()

    def _estimate_motion(self) -> None:
        """Update the motion estimates, from which tilt is derived."""
        for i, track in enumerate(self._tracks):
            if track.measured is None:
                continue
            place_m, motion = track.measured.pose[:2], self._motions[i]
            if motion is None:
                self._motions[i] = MotionEstimate.at_rest(place_m, 0.0)
            elif np.linalg.norm(place_m - motion.position_m) > self.radius_m:  # it was carried, or is another robot
                self._motions[i] = MotionEstimate.at_rest(place_m, motion.residual_tilt_rad)
            else:
                self._motions[i] = motion.with_position(place_m, self._tilt)

    def _poses(self, depths: Sequence[Depth], views: Mapping[int, PredictedView]) -> tuple[tuple[int, Pose], ...]:
        """Poses of the robots that have one; their covariances include the tilt and the track."""
        messages = []
        for i, (robot, track, depth) in enumerate(zip(self._ids, self._tracks, depths, strict=True)):
            down = views[i].tangent.jacobian[:, 2] if i in views else np.zeros(2)
            attitude = self._attitudes[i]
            ahead_m, aside_m, _ = (0.0, 0.0, 0.0) if attitude is None else attitude.above_m(self.marker_height_m)
            unknown = self._tilt.covariance(self._motions[i], attitude, down) + track.doubt(self.radius_m)
            messages.append((robot, track.message(depth.centre_m, unknown, (ahead_m, aside_m))))
        return tuple((robot, pose) for robot, pose in messages if pose is not None)

    def _status_message(self, camera: CameraHealth) -> str:
        """One line for the operator; empty when all is well."""
        if camera is not CameraHealth.OK:
            return f"camera {camera.name.lower().replace('_', ' ')}"
        pairs = list(zip(self._ids, self._tracks, strict=True))
        lost = [str(i) for i, track in pairs if track.state is Track.LOST]
        doubted = [str(i) for i, track in pairs if track.state is not Track.LOST and not track.verified]
        strange = [str(i) for i, scans in self._foreign_scans.items() if lost and scans >= _STRANGE_SCANS]
        outside = [
            str(self._ids[i])
            for i, frame in self._outside_frames.items()
            if self._is_lost(i) and self._frames - frame <= _STRIPS
        ]
        parts = (
            ("lost: robot", lost if self._sees_all else []),
            ("seen outside the pool or in a mask: robot", outside),
            ("identity not verified: robot", doubted),
            ("in view, but no robot's: marker", strange),
            ("in view twice: the marker of robot", [str(self._ids[i]) for i in self._twins.twins(self._frames)]),
        )
        notes = [f"{what} {', '.join(ids)}" for what, ids in parts if ids] + self._sizes.in_words(self._ids, self._frames)
        notes += self._attitude_check.in_words(self._ids)
        return "; ".join([self._camera_pose.trouble, *notes] if self._camera_pose.trouble else notes)

    def _scan(self, located: _Located) -> None:
        """While a robot is lost, read the markers where it was lost and in the picture's next strip; in all of the picture in
        every fifth frame as long as no robot is followed. What is found is a claim, which the next frame confirms."""
        lost = [self._is_lost(i) for i in range(len(self._tracks))]
        if not self._settings.markers or not (any(lost) or self._frames % _TWINS_EVERY == 0):
            return
        regions, strip = [view.region for i, view in located.views.items() if lost[i]], self._frames % _STRIPS
        if not any(lost):
            regions.append(self._strip(located.frame, self._frames // _TWINS_EVERY % _STRIPS))
        elif not all(lost):
            regions.append(self._strip(located.frame, strip))
        elif strip == 1:
            regions.append(whole(located.frame))
        plates_m = np.array([depth.plate_m for depth in located.depths])
        for i, reading in self._read(regions, plates_m, self._tilts_rad()).items():
            if lost[i] or not self._near_track(i, [reading]):
                self._tracks[i] = self._tracks[i].with_scan(reading.pose, self.radius_m)
        if not any(lost):
            return
        self._foreign_ids |= self._reader.foreign_ids - self._landmark_ids
        if all(lost) or strip == 0:
            self._foreign_scans = {i: self._foreign_scans.get(i, 0) + 1 for i in sorted(self._foreign_ids)}
            self._foreign_ids = set()

    def _strip(self, frame: Pixels, strip: int) -> ImageRegion:
        """A horizontal strip of the picture, the first from the top being number 1 and the last 0, with part of the next."""
        height = frame.shape[0]
        number = (strip - 1) % _STRIPS
        top = number * height // _STRIPS // 2 * 2
        bottom = (number + 1) * height // _STRIPS + self._overlap_px
        return ImageRegion(frame[top : min(bottom, height) // 2 * 2], 0, top)

    def _update_appearance(self, views: Mapping[int, PredictedView]) -> None:
        """Report the correlation peak of the robots whose turn it is, so that its fall is visible before a match is needed;
        update the appearance where the pose is certain, with no other robot in the patch."""
        apart_m = self._appearance.reach_m + self.radius_m
        due_views, poses, rates = list[PredictedView](), list[Array](), list[float]()
        for i, view in views.items():
            is_its_turn = (self._frames + i) % _LEARN_EVERY == 0 or not self._appearance.is_initialised(i)
            if not is_its_turn:
                continue
            pose = self._best_pose(view.robot)
            is_certain = self._is_certain(view.robot) and self._clearance_m(view.robot, pose) > apart_m
            if is_certain or self._tracks[view.robot].state is Track.MARKER:
                due_views.append(view)
                poses.append(pose)
                rates.append(_LEARNING_RATE if is_certain else 0.0)
        peaks = self._appearance.update(due_views, poses, np.array(rates, dtype=np.float64))
        for view, peak in zip(due_views, peaks, strict=True):
            if self._tracks[view.robot].state is Track.MARKER:
                self._tracks[view.robot] = self._tracks[view.robot].with_peak(peak)

    # --- small questions

    def _tilts_rad(self) -> Array:
        """Roll and pitch (robots, 2) at the present exposure, or as they were read in the frame before; 0 where they are not
        known."""
        attitudes = [now or before for now, before in zip(self._attitudes, self._leans_before, strict=True)]
        return np.array([[0.0, 0.0] if a is None else [a.roll_rad, a.pitch_rad] for a in attitudes])

    @property
    def view(self) -> RefractiveCamera:
        """The newest mapping between pixels and pool."""
        return self._camera_pose.view

    def _best_pose(self, robot: int) -> Array:
        """[x, y, yaw] of a robot: this frame's measurement, or the prediction."""
        track = self._tracks[robot]
        if track.measured is not None:
            return track.measured.pose
        return np.zeros(3) if track.motion is None else track.motion.mean[:3]

    def _late_s(self, view: PredictedView) -> float:
        """Time from the picture's stamp, which is its middle row's, to the exposure of the row that a robot is in."""
        camera = self._experiment.camera
        return camera.readout_s * (float(view.tangent.pixel[1]) / camera.size_px[1] - 0.5)

    def _coasts_outside(self, track: RobotTrack) -> bool:
        """True if a track was predicted to where no robot can be."""
        return track.state is Track.COAST and track.motion is not None and not self._gate.inside(track.motion.position_m)

    def _is_lost(self, robot: int) -> bool:
        return self._tracks[robot].state is Track.LOST

    def _is_certain(self, robot: int) -> bool:
        """True if a robot's pose is good enough to learn its appearance there. Without markers, the first pose is the
        start's."""
        track = self._tracks[robot]
        if self._settings.markers:
            return track.state is Track.MARKER and track.measured is not None and track.verified
        return not self._appearance.is_initialised(robot) or (track.measured is not None and track.peak > _SURE_PEAK)

    def _clearance_m(self, robot: int, pose: Array) -> float:
        """Distance from a pose's position to the nearest other robot."""
        others = (t.motion.position_m for i, t in enumerate(self._tracks) if i != robot and t.motion is not None)
        return min((math.dist(other, pose[:2]) for other in others), default=math.inf)


def _camera_pose(experiment: Experiment) -> CameraPoseTracker | FixedCameraPose:
    """The tracker of the camera's pose that an experiment asks for."""
    if experiment.landmarks:
        return CameraPoseTracker(experiment.camera, experiment.landmarks, experiment.localizer.marker_family)
    if experiment.check_marks:
        return CheckedCameraPose(experiment.camera, experiment.check_marks, experiment.localizer.marker_family)
    return FixedCameraPose(experiment.camera)


def start_poses(experiment: Experiment) -> Array:
    """Expected [x, y, z, yaw] of each robot at the start, (robots, 4), pool frame; used before a robot was seen.

    The path's first point and tangent (equations 12, 13), the formation's node (14-16), then the robot's own offset. An
    explicit `start` replaces all of that. Only a fleet without markers depends on x, y and yaw.
    """
    poses = []
    for robot, node in zip(experiment.robots, experiment.nodes_m(), strict=True):
        centre, tangent_rad = _path_start(experiment.path_of(robot))
        turn = tangent_rad - np.pi / 2 if experiment.formation.mode == "rotate" else 0.0
        c, s = np.cos(turn), np.sin(turn)
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        reference = np.append(centre + rotation @ node, tangent_rad)
        poses.append(np.array(robot.start) if robot.start is not None else reference + np.array(robot.start_offset))
    return np.array(poses)


def _path_start(path: PathSpec) -> tuple[Array, float]:
    """First point (3,) of a path, and the heading of its tangent."""
    if isinstance(path, Circle):
        return np.array([path.diameter_m / 2.0, 0.0, path.depth_m]), np.pi / 2
    if isinstance(path, Route):  # the planner may begin with another heading, around an obstacle; the point is right
        (x, y), (next_x, next_y) = path.via_m[:2]
        return np.array([x, y, path.depth_m]), float(np.arctan2(next_y - y, next_x - x))
    points = np.array(path.points_m)
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    spline = CubicSpline(along, points, bc_type="natural")
    tangent = spline(along[path.start_index], 1)
    return np.append(points[path.start_index], path.depth_m), float(np.arctan2(tangent[1], tangent[0]))
