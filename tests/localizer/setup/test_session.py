"""A setup from the first picture to the saved file, with a rendered board and pool whose camera is known."""

import errno
import threading
import tomllib
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w

from localizer.calibration.extrinsics import fit_pose
from localizer.calibration.report import intrinsics_lines
from localizer.detection.image_regions import Pixels
from localizer.setup import experiment_file
from localizer.setup.camera_feed import CameraFeed
from localizer.setup.experiment_file import ExperimentFile
from localizer.setup.session import SetupSession
from localizer.sources.base import CapturedFrame
from localizer.sources.v4l2_controls import CameraControl, V4l2Controls
from shoal.config.experiment import EXPERIMENTS, NO_CAMERA, load_experiment
from shoal.errors import ConfigError
from shoal.runtime.runtime import Stop
from sim_bridge.camera.optics import project
from tests.localizer.board_scene import CameraBench, charuco, chessboard, marks
from tests.localizer.small_basin import BOARD, FLOOR, POOL_M, RIM, TRUTH
from tests.waiting import eventually

pytestmark = pytest.mark.long

BENCH = CameraBench(TRUTH)
PATIENCE_S = 20.0
LAB = f"""# our lab
name = "lab"
duration_s = 10.0
vehicle = "spherical"           # as shipped

[pool]
size_m = {POOL_M}

[path]
kind = "circle"
diameter_m = 0.45
lap_s = 100.0
depth_m = 0.3

[[robots]]
id = 1
node_m = [0.0, 0.0, 0.0]

[camera]                        # over the deep end
size_px = [480, 360]
rate_hz = 20.0                  # what USB allows
exposure_s = 0.008
focal_px = [400.0, 400.0]       # guessed
centre_px = [239.5, 179.5]
position_m = [0.0, 0.0, -2.5]

[limits]                        # not yet
"""


class HandControls:
    """A camera's controls without a camera."""

    def __init__(self) -> None:
        self.gain, self.exposure = 10, 80

    def offered(self) -> tuple[CameraControl, ...]:
        gain = CameraControl("gain", self.gain, 0, 100, 1, 32)
        return gain, CameraControl("exposure_time_absolute", self.exposure, 1, 500, 1, 100)

    def set(self, name: str, value: int) -> None:
        if name == "gain":
            self.gain = self.offered()[0].checked(value)
        else:
            self.exposure = self.offered()[1].checked(value)


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(LAB, encoding="utf-8")
    return path


def begin(file: Path, controls: HandControls | None = None) -> SetupSession:
    changed = ExperimentFile(file, None)
    loaded = load_experiment(str(file), () if changed.has_camera else [NO_CAMERA])
    return SetupSession(loaded, changed, "test", controls)


def show(session: SetupSession, picture: Pixels) -> None:
    session.take(CapturedFrame(picture, 0, 0, 0), 0.05)


def pool_picture() -> Pixels:
    return BENCH.pool([(0.8, marks(FLOOR, 0.25)), (-0.1, marks(RIM, 0.2))])


def place_of(number: int) -> list[float]:
    return [*FLOOR[number], 0.8] if number in FLOOR else [*RIM[number], -0.1]


def do(session: SetupSession, request: str, /, **given: Any) -> Any:
    return session.do(request, given)


def said(session: SetupSession) -> str:
    return " ".join(session.state(1)["said"])


def survey(session: SetupSession, wrong: Mapping[int, list[float]] | None = None) -> None:
    for number in (*RIM, *FLOOR):
        place = (wrong or {}).get(number, place_of(number))
        do(session, "point", name=f"mark {number}", pool_m=place, marker_id=number)


@pytest.mark.parametrize("has_camera", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_a_waved_board_gives_the_lens_and_clicked_points_the_pose_that_the_file_then_holds(
    file: Path, has_camera: bool
) -> None:
    if not has_camera:
        file.write_text(LAB[: LAB.index("[camera]")] + LAB[LAB.index("[limits]") :], encoding="utf-8")
    session, texture = begin(file), charuco((7, 5), 0.04, 0.03)
    do(session, "board", board=BOARD)
    do(session, "collect", on=True)
    board_m = np.array([[x, y, 0.0] for x in (0.0, 0.28) for y in (0.0, 0.2)])
    for turn, move in BENCH.poses(24, board_m, seed=4, margin_px=-20.0):
        picture = BENCH.picture(texture, np.zeros(2), turn, move)
        for noise in (0, 1):  # held still for two pictures
            show(session, picture + np.uint8(noise) * np.uint8(picture < 250))
            session.look_for_board()
    lens = session.state(1)["lens"]
    assert 12 <= len(lens["views"]) <= 24  # some are like others, or show too little
    assert np.mean(np.array(lens["coverage"]) > 0) > 0.8
    do(session, "fit-lens")
    assert "px in views held out" in said(session)

    show(session, pool_picture())
    assert do(session, "markers") == sorted([*RIM, *FLOOR])
    survey(session)
    corner = np.array([FLOOR[14][0] - 0.125, FLOOR[14][1] - 0.125, 0.8])  # of a marker's black square
    clicked = project(TRUTH, corner[None])[0] + [1.4, -0.9]
    do(session, "point", name="clicked", pool_m=corner.tolist(), pixel_px=clicked.tolist())
    assert "at a corner" in said(session)
    do(session, "fit-pose")
    residuals = {row["name"]: row for row in session.state(1)["survey"]["residuals"]}
    assert max(row["error_px"] for row in residuals.values()) < 1.0
    assert max(row["error_mm"] for row in residuals.values()) < 8.0  # one pixel

    difference = "\n".join(do(session, "difference")["lines"])
    assert ("-focal_px = [400.0, 400.0]       # guessed" in difference) is has_camera and "+focal_px = [3" in difference
    do(session, "save")
    text = file.read_text(encoding="utf-8")
    camera = load_experiment(str(file)).camera
    assert camera.focal_px == pytest.approx(TRUTH.focal_px, rel=0.005)
    assert camera.position_m == pytest.approx(TRUTH.position_m, abs=0.02)
    if not has_camera:  # all its keys are those of this camera
        assert (camera.size_px, camera.rate_hz) == ((480, 360), 20.0) and "# our lab" in text and "# not yet" in text
        return
    for kept in (
        "# our lab",
        "# as shipped",
        "# over the deep end",
        "rate_hz = 20.0                  # what USB allows",
        "# not yet",
    ):
        assert kept in text
    old = [path for path in file.parent.iterdir() if path != file]
    assert [path.read_text(encoding="utf-8") for path in old] == [LAB]


@pytest.fixture
def true_file(file: Path) -> Path:
    """The experiment with the true lens."""
    table = tomllib.loads(LAB)
    lens = TRUTH.model_dump(mode="json", include={"focal_px", "centre_px", "distortion"})
    file.write_text(tomli_w.dumps(table | {"camera": table["camera"] | lens}), encoding="utf-8")
    return file


def test_a_point_that_was_measured_wrong_is_named(true_file: Path) -> None:
    session = begin(true_file)
    show(session, pool_picture())
    x, y, z = place_of(12)
    survey(session, {12: [x + 0.1, y, z]})
    do(session, "fit-pose")
    assert [row["name"] for row in session.state(1)["survey"]["residuals"] if row["bad"]] == ["mark 12"]
    assert "'mark 12' does not fit" in said(session)
    do(session, "point", name="mark 12", pool_m=[x, y, z], marker_id=12)
    do(session, "fit-pose")
    assert not any(row["bad"] for row in session.state(1)["survey"]["residuals"])


def test_the_outline_comes_by_the_pose_and_masks_are_drawn_changed_and_deleted(true_file: Path) -> None:
    session = begin(true_file)
    show(session, pool_picture())
    survey(session)
    do(session, "fit-pose")
    state = session.state(1)
    for name, pixel in state["outline"].items():
        assert np.linalg.norm(pixel - project(TRUTH, np.array([state["outline_m"][name]]))[0]) < 1.0
    assert len(state["outline"]) >= 4
    triangle = [[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]]
    do(session, "mask", corners_px=triangle)
    do(session, "mask", corners_px=[[200.0, 200.0], *triangle[1:]])
    first, second = (mask["id"] for mask in session.state(1)["masks"])
    do(session, "mask", id=first, corners_px=[[12.0, 11.0], *triangle[1:]])
    do(session, "mask", id=second, corners_px=[])
    do(session, "save")
    assert load_experiment(str(true_file)).camera.masks_px == (((12.0, 11.0), (60.0, 10.0), (10.0, 90.0)),)


def test_when_the_camera_changes_its_size_the_work_is_kept_and_comes_back(true_file: Path) -> None:
    session = begin(true_file)
    show(session, pool_picture())
    survey(session)
    do(session, "mask", corners_px=[[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]])
    show(session, np.zeros((240, 320), np.uint8))
    state = session.state(1)
    assert (state["survey"]["points"], state["masks"]) == ([], [])
    assert "pictures are 320x240 now" in said(session) and "find the lens first" in said(session)
    with pytest.raises(ConfigError, match="pictures are 320x240, and the experiment's lens is for 480x360"):
        do(session, "fit-pose")
    show(session, pool_picture())
    assert len(session.state(1)["survey"]["points"]) == 9 and len(session.state(1)["masks"]) == 1


def test_controls_are_set_and_saved_and_a_wrong_value_is_refused_with_what_is_allowed(file: Path) -> None:
    controls = HandControls()
    session = begin(file, controls)
    do(session, "control", name="gain", value=20)
    do(session, "control", name="exposure_time_absolute", value=120)
    with pytest.raises(ConfigError, match=r"camera.controls.gain = 200: not offered \(allowed: 0 to 100\)"):
        do(session, "control", name="gain", value=200)
    show(session, np.full((360, 480), 255, np.uint8))
    verdicts = [verdict["text"] for verdict in session.state(1)["figures"]["verdicts"]]
    assert verdicts[0].startswith("too bright: 100.0% of the pixels are white")
    assert verdicts[2].startswith("a robot at 0.1 m/s smears over 1.20 mm in 12.0 ms (limit 1 mm)")
    do(session, "save")
    camera = load_experiment(str(file)).camera
    assert (camera.controls, camera.exposure_s) == ((("gain", 20),), 0.012)
    do(session, "defaults")
    assert (controls.gain, controls.exposure) == (32, 100)
    assert begin(file).state(1)["no_controls"] == "this source offers no controls"
    with pytest.raises(ConfigError, match="controls of /dev/video99: "):
        V4l2Controls("/dev/video99").offered()


def test_focus_is_told_against_the_best_so_far(file: Path) -> None:
    session, sharp = begin(file), pool_picture()
    for picture, good in ((cv2.blur(sharp, (5, 5)), True), (sharp, True), (cv2.blur(sharp, (3, 3)), False)):
        show(session, np.asarray(picture, dtype=np.uint8))
        assert session.state(1)["figures"]["verdicts"][1]["good"] is good


class UnpluggedOnce:
    """A camera that is unplugged and plugged in again: a step at a time, as the test says."""

    silent_after_s = 0.1

    def __init__(self) -> None:
        self.trouble, self.plugged, self.unplugged = "", threading.Event(), threading.Event()

    def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
        yield CapturedFrame(pool_picture(), 0, 0, 10**9)
        self.trouble = "/dev/video0 stopped delivering"
        yield None
        self.unplugged.set()
        self.plugged.wait(60.0)
        yield CapturedFrame(pool_picture(), 0, 0, 2 * 10**9)
        eventually(stop, 60.0)

    def close(self) -> None:
        """Nothing to release."""


def test_a_camera_that_is_unplugged_is_told_and_the_work_goes_on_when_it_is_back(file: Path) -> None:
    session, source, stop = begin(file), UnpluggedOnce(), Stop(install=False)
    with closing(CameraFeed(source, session, stop)):
        assert source.unplugged.wait(60.0)
        do(session, "mask", corners_px=[[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]])
        assert session.state(1)["trouble"] == "/dev/video0 stopped delivering"
        source.plugged.set()
        assert eventually(lambda: session.state(1)["trouble"] == "", 60.0)
        assert len(session.state(1)["masks"]) == 1
        stop.request()


def test_a_recording_that_is_over_leaves_its_last_picture_to_work_on(file: Path) -> None:
    """As trouble it would darken the picture that the grid lies on, and cover its lower edge."""

    class ShortRecording(UnpluggedOnce):
        def frames(self, stop: Stop) -> Iterator[CapturedFrame | None]:
            yield CapturedFrame(pool_picture(), 0, 0, 10**9)
            self.trouble = "no picture for 0.1 s"
            yield None

    session, stop = begin(file), Stop(install=False)
    with closing(CameraFeed(ShortRecording(), session, stop)):
        assert eventually(lambda: "the recording is over; its last picture stays" in session.state(1)["said"], 60.0)
        assert session.state(1)["trouble"] == ""
        stop.request()


# --- files


def masked(file: Path) -> SetupSession:
    session = begin(file)
    do(session, "mask", corners_px=[[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]])
    return session


def test_a_file_that_somebody_else_changed_is_not_written_over(file: Path) -> None:
    session = masked(file)
    file.write_text(LAB.replace("duration_s = 10.0", "duration_s = 20.0"), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"lab.toml: was changed by somebody else"):
        do(session, "save")
    do(session, "reload")
    do(session, "save")
    saved = load_experiment(str(file))
    assert saved.duration_s == 20.0 and len(saved.camera.masks_px) == 1


def test_a_lens_that_somebody_else_wrote_into_the_file_is_taken_up_and_a_pose_by_another_is_not_saved(file: Path) -> None:
    session = begin(file)
    show(session, pool_picture())
    survey(session)
    do(session, "fit-pose")
    table = tomllib.loads(LAB)
    lens = TRUTH.model_dump(mode="json", include={"focal_px", "centre_px", "distortion"})
    file.write_text(tomli_w.dumps(table | {"camera": table["camera"] | lens | {"masks_px": [MASK]}}), encoding="utf-8")
    do(session, "reload")
    state = session.state(1)
    assert state["changed"] == {} and state["survey"]["residuals"] == [] and "find the pose again" in said(session)
    assert [mask["corners_px"] for mask in state["masks"]] == [MASK]
    do(session, "fit-pose")
    assert set(session.state(1)["changed"]) == {"position_m", "rotation_rad"}
    do(session, "save")
    saved = load_experiment(str(file)).camera
    assert saved.position_m == pytest.approx(TRUTH.position_m, abs=0.02) and saved.focal_px == TRUTH.focal_px


@pytest.mark.parametrize("content", [b"duration_s = ", b"duration_s = -5.0", b"\xff\xfe", None])
def test_a_file_that_is_no_experiment_is_not_taken_up(file: Path, content: bytes | None) -> None:
    """Somebody is half-way through a change, or has moved it away. The page goes on, with what the file held before."""
    session = masked(file)
    before = session.state(1)
    if content is None:
        file.unlink()
    else:
        file.write_bytes(LAB.encode().replace(b"duration_s = 10.0", content))
    for request in ("reload", "save"):
        with pytest.raises(ConfigError, match=r"lab.toml: "):
            do(session, request)
        assert session.state(1) == before
    file.write_text(LAB, encoding="utf-8")
    do(session, "reload")
    do(session, "save")
    assert len(load_experiment(str(file)).camera.masks_px) == 1


def test_a_full_disk_is_told_and_the_work_is_still_there(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    session = masked(file)

    @contextmanager
    def full(path: Path, **options: object) -> Any:
        raise OSError(errno.ENOSPC, "No space left on device", str(path))
        yield

    with monkeypatch.context() as disk:
        disk.setattr(experiment_file, "replacing", full)
        with pytest.raises(ConfigError, match="No space left on device"):
            do(session, "save")
    assert file.read_text(encoding="utf-8") == LAB
    do(session, "save")
    assert "masks_px" in file.read_text(encoding="utf-8")


def test_a_camera_in_a_file_of_its_own_is_changed_there(file: Path) -> None:
    table = tomllib.loads(LAB)
    camera = file.with_name("camera.toml")
    camera.write_text("# found in May\n[camera]\n" + tomli_w.dumps(table["camera"]), encoding="utf-8")
    file.write_text(tomli_w.dumps(table | {"camera": "camera.toml"}), encoding="utf-8")
    before = file.read_bytes()
    do(masked(file), "save")
    assert file.read_bytes() == before and "# found in May" in camera.read_text(encoding="utf-8")
    assert len(load_experiment(str(file)).camera.masks_px) == 1


MASK = [[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]]


def test_a_second_click_on_save_keeps_the_old_file(file: Path) -> None:
    """Two saves in one second, of which the second has nothing to write; and two that do, in one second."""
    session = begin(file)
    do(session, "mask", corners_px=MASK)
    do(session, "save")
    with pytest.raises(ConfigError, match="nothing was changed"):
        do(session, "save")
    do(session, "mask", corners_px=[[20.0, 10.0], *MASK[1:]])
    do(session, "save")
    kept = sorted(path.read_text(encoding="utf-8") for path in file.parent.glob("lab.toml.*"))
    assert len(kept) == 2 and LAB in kept


def test_a_saved_mask_can_be_deleted(file: Path) -> None:
    session = begin(file)
    do(session, "mask", corners_px=MASK)
    do(session, "save")
    assert len(load_experiment(str(file)).camera.masks_px) == 1 and session.state(1)["changed"] == {}
    do(session, "mask", id=1, corners_px=[])
    assert list(session.state(1)["changed"]) == ["masks_px"]
    do(session, "save")
    assert load_experiment(str(file)).camera.masks_px == ()


def test_a_lens_that_is_found_after_the_pose_takes_the_pose_and_its_residuals_away(file: Path) -> None:
    session = begin(file)
    show(session, pool_picture())
    survey(session)
    do(session, "fit-pose")
    assert session.state(1)["survey"]["residuals"]
    # private: the views as the board's thread gathers them from a board that is waved
    # no page can give views as quickly
    session._work.lens.views = BENCH.views(12, chessboard(9, 6, 0.03)[2], seed=2, noise_px=0.05)
    do(session, "fit-lens")
    state = session.state(1)
    assert state["survey"]["residuals"] == [] and state["survey"]["report"] == []
    assert "the pose is older than the lens" in said(session) and "position_m" not in state["changed"]
    do(session, "fit-pose")
    assert "older" not in said(session) and {"focal_px", "position_m"} <= set(session.state(1)["changed"])
    do(session, "save")
    assert session.state(1)["changed"] == {}, "what was saved is the base of the next changes"
    assert load_experiment(str(file)).camera.position_m == pytest.approx(TRUTH.position_m, abs=0.02)


def test_the_page_lives_while_a_lens_is_judged_and_has_all_of_it_or_nothing(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """To judge sixty views takes minutes. A judgement that fails leaves the lens of before."""
    session, judged = begin(file), intrinsics_lines
    begun, released = threading.Event(), threading.Event()
    # no page can give views as quickly
    session._work.lens.views = BENCH.views(12, chessboard(9, 6, 0.03)[2], seed=2, noise_px=0.05)  # private: as above

    def slow(*arguments: Any) -> list[str]:
        begun.set()
        if not released.wait(PATIENCE_S):
            raise ConfigError("nobody could look meanwhile")
        return judged(*arguments)

    monkeypatch.setattr("localizer.setup.session.intrinsics_lines", slow)
    with ThreadPoolExecutor(2) as threads:
        fit = threads.submit(do, session, "fit-lens")
        assert begun.wait(PATIENCE_S)
        before = threads.submit(session.state, 1).result(PATIENCE_S / 2)
        assert before["lens"]["report"] == [] and before["changed"] == {}
        released.set()
        fit.result(PATIENCE_S)
    state_before = session.state(1)
    assert state_before["lens"]["report"] and "focal_px" in state_before["changed"]
    assert state_before["changed"]["focal_px"] == pytest.approx(TRUTH.focal_px, rel=0.01)
    # no page can give views as quickly
    session._work.lens.views = BENCH.views(12, chessboard(9, 6, 0.03)[2], seed=3, noise_px=0.05)

    def fails(*arguments: Any) -> list[str]:
        raise ConfigError("no lens explains the 8 views of the board")

    monkeypatch.setattr("localizer.setup.session.intrinsics_lines", fails)
    with pytest.raises(ConfigError, match="explains"):
        do(session, "fit-lens")
    assert session.state(1)["changed"] == state_before["changed"]


def test_a_pose_by_the_lens_of_before_is_not_taken(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another page finds a lens while the pose is being found."""
    session, fitted = begin(file), fit_pose
    show(session, pool_picture())
    survey(session)
    # no page can give views as quickly
    session._work.lens.views = BENCH.views(12, chessboard(9, 6, 0.03)[2], seed=2, noise_px=0.05)  # private: as above

    def late(*arguments: Any) -> Any:
        result = fitted(*arguments)
        do(session, "fit-lens")
        return result

    monkeypatch.setattr("localizer.setup.survey_step.fit_pose", late)
    with pytest.raises(ConfigError, match="another lens was found meanwhile"):
        do(session, "fit-pose")
    assert "focal_px" in session.state(1)["changed"] and "position_m" not in session.state(1)["changed"]


@pytest.mark.parametrize(
    ("request_name", "arguments"),
    [
        ("point", {"name": "z", "pool_m": [0.2, 0.2, 0.0], "pixel_px": [250.0, 200.0]}),
        ("remove-point", {"name": "mark 12"}),
        ("point", {"name": "mark 12", "pool_m": [0.0, 0.0, 0.0], "pixel_px": [250.0, 200.0]}),
    ],
    ids=["one more", "one less", "another place"],
)
def test_a_pose_is_told_by_the_points_that_it_is_from(
    true_file: Path, monkeypatch: pytest.MonkeyPatch, request_name: str, arguments: dict[str, Any]
) -> None:
    """Another page changes the points while the pose is being found."""
    session, fitted = begin(true_file), fit_pose
    show(session, pool_picture())
    survey(session)
    do(session, "fit-pose")
    report = session.state(1)["survey"]["report"]

    def late(*given: Any) -> Any:
        result = fitted(*given)
        do(session, request_name, **arguments)
        return result

    monkeypatch.setattr("localizer.setup.survey_step.fit_pose", late)
    do(session, "fit-pose")
    state = session.state(1)["survey"]
    assert state["report"] == report
    assert {row["name"] for row in state["residuals"]} == {point["name"] for point in state["points"]} - {arguments["name"]}


def test_a_point_may_have_any_marker_of_the_experiments_family(file: Path) -> None:
    point = {"name": "a", "pool_m": [0.0, 0.0, 0.0], "marker_id": 120}
    with pytest.raises(ConfigError, match=r"'a': marker_id = 120: 4x4_50 has no such marker"):
        do(begin(file), "point", **point)
    file.write_text(LAB + '\n[localizer]\nmarker_family = "apriltag_36h11"\n', encoding="utf-8")
    session = begin(file)
    do(session, "point", **point)
    for k, place in enumerate([[0.4, 0.0, 0.0], [0.4, 0.3, 0.0], [-0.4, 0.3, 0.0]]):
        do(session, "point", name=str(k), pool_m=place, pixel_px=[100.0 * k + 50.0, 90.0 + 30.0 * (k % 2)])
    show(session, pool_picture())
    with pytest.raises(ConfigError, match="marker_id = 120: 0 markers of that id are in the picture"):
        do(session, "fit-pose")


def test_no_number_is_no_request(file: Path) -> None:
    """The grid is drawn at the depth that a page asks for, for all pages."""
    session = begin(file)
    show(session, pool_picture())
    for name, given in (
        ("grid", {"depth_m": float("nan")}),
        ("mask", {"corners_px": [[1.0, 2.0], [float("inf"), 3.0], [4.0, 5.0]]}),
    ):
        with pytest.raises(ConfigError, match=f"{name}: NaN or an infinity"):
            session.do(name, given)
    assert session.jpeg() and session.state(1)["changed"] == {}


def test_an_experiment_with_several_cameras_is_refused_before_any_work(tmp_path: Path) -> None:
    for out in (None, tmp_path / "mine.toml"):
        path = tmp_path / "two.toml"
        path.write_text((EXPERIMENTS / "two-cameras.toml").read_text(encoding="utf-8"), encoding="utf-8")
        with pytest.raises(ConfigError, match=r"two\.toml: has several cameras, and a setup is of one"):
            ExperimentFile(path, out)


def test_a_shipped_experiment_is_saved_as_a_new_file(tmp_path: Path) -> None:
    shipped = EXPERIMENTS / "pool.toml"
    with pytest.raises(ConfigError, match="pool: a shipped experiment is not changed"):
        ExperimentFile(shipped, None)
    new = tmp_path / "mine.toml"
    session = SetupSession(load_experiment("pool"), ExperimentFile(shipped, new), "test", None)
    do(session, "mask", corners_px=[[10.0, 10.0], [60.0, 10.0], [10.0, 90.0]])
    do(session, "save")
    do(session, "mask", corners_px=[[20.0, 10.0], [60.0, 10.0], [10.0, 90.0]])
    do(session, "save")  # now over its own file
    assert len(load_experiment(str(new)).camera.masks_px) == 2
    with pytest.raises(ConfigError, match="is there already"):
        ExperimentFile(shipped, new)


def test_a_place_from_which_the_experiment_could_not_be_loaded_is_refused_before_any_work(tmp_path: Path) -> None:
    """It names its vehicle's file, which is sought beside it."""
    for folder in ("here", "there"):
        (tmp_path / folder).mkdir()
    vehicle = (EXPERIMENTS.parent / "vehicles" / "spherical.toml").read_bytes()
    (tmp_path / "here" / "ours.toml").write_bytes(vehicle)
    lab, new = tmp_path / "here" / "lab.toml", tmp_path / "there" / "new.toml"
    lab.write_text(LAB.replace('"spherical"', '"ours.toml"'), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"there.new\.toml: .*ours\.toml: no such file"):
        ExperimentFile(lab, new)
    (tmp_path / "there" / "ours.toml").write_bytes(vehicle)
    ExperimentFile(lab, new).save({"exposure_s": 0.005})
    assert load_experiment(str(new)).camera.exposure_s == 0.005


@pytest.mark.parametrize(
    ("name", "given", "why"),
    [
        ("dance", {}, "no such request"),
        ("point", {"name": "p"}, "point: KeyError"),
        ("point", {"name": "", "pool_m": [0, 0, 0], "pixel_px": [1, 1]}, "this point: name"),
        ("mask", {"corners_px": [["a", 1]]}, "mask: ValueError"),
        ("board", {"board": "quilt:3x3"}, "not a board"),
        ("fit-lens", {}, "at least 5 are needed"),
        ("fit-pose", {}, "at least 4 are needed"),
        ("save", {}, "nothing was changed"),
        ("control", {"name": "gain", "value": 1}, "no controls"),
    ],
)
def test_a_request_that_cannot_be_done_says_why(file: Path, name: str, given: dict[str, Any], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        do(begin(file), name, **given)
