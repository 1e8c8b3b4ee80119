"""`localizer calibrate` and `localizer check` as a lab uses them: files in, files and lines out, errors that help."""

import struct
import subprocess
import sys
import threading
import tomllib
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from localizer.__main__ import app
from localizer.calibration.images import pictures, read_picture
from localizer.calibration.verify import LivePictures, show_live
from localizer.detection.image_regions import BAYER_TO_BGR
from localizer.sources.base import SUFFIXES
from localizer.sources.files import FolderSource
from localizer.view.mjpeg_server import MjpegServer
from shoal.bus.bus import Bus
from shoal.bus.memory_transport import MemoryHub, MemoryTransport
from shoal.config.experiment import EXPERIMENTS, load_experiment
from shoal.config.perception import Camera
from shoal.errors import ConfigError
from shoal.frames import Array
from shoal.messages import topics
from shoal.messages.messages import Frame
from shoal.runtime.runtime import Stop, WallClock
from sim_bridge.camera.optics import project, rays
from tests.localizer.board_scene import CameraBench, charuco, marks
from tests.localizer.scene import bayer
from tests.localizer.small_basin import BOARD, FLOOR, POOL_M, RIM, TRUTH
from tests.waiting import eventually

VIEWS = 14


def _points() -> list[dict[str, object]]:
    rim = [{"name": f"rim {i}", "pool_m": [*place, -0.1], "marker_id": i} for i, place in RIM.items()]
    return rim + [{"name": f"floor {i}", "pool_m": [*place, 0.8], "marker_id": i} for i, place in FLOOR.items()]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with pictures of a board, one of the pool, and a points file. Tests write into folders of their own."""
    folder = tmp_path_factory.mktemp("lab")
    (folder / "board").mkdir()
    bench, texture = CameraBench(TRUTH), charuco((7, 5), 0.04, 0.03)
    board_m = np.array([[x, y, 0.0] for x in (0.0, 0.28) for y in (0.0, 0.2)])
    for i, (turn, move) in enumerate(bench.poses(VIEWS, board_m, seed=4, margin_px=-20.0)):
        cv2.imwrite(str(folder / "board" / f"{i:02}.png"), bench.picture(texture, np.zeros(2), turn, move))
    cv2.imwrite(str(folder / "board" / "99-empty.png"), np.full((360, 480), 90, np.uint8))
    cv2.imwrite(str(folder / "pool.png"), bench.pool([(0.8, marks(FLOOR, 0.25)), (-0.1, marks(RIM, 0.2))]))
    table = {"pool": {"size_m": POOL_M}, "image": "pool.png", "points": _points()}
    (folder / "points.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    return folder


def _run(monkeypatch: pytest.MonkeyPatch, *arguments: object) -> int:
    """Exit code of the command line."""
    monkeypatch.setattr(sys, "argv", ["localizer", *map(str, arguments)])
    with pytest.raises(SystemExit) as ended:
        app()
    return int(ended.value.code or 0)


def _calibrate(monkeypatch: pytest.MonkeyPatch, lab: Path, out: Path, *more: object) -> int:
    return _run(monkeypatch, "calibrate", lab / "board", "--board", BOARD, "--grey", "--out", out, *more)  # as drawn


def _experiment(folder: Path) -> Path:
    """The pool experiment with its camera in a file."""
    table = tomllib.loads((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"))
    path = folder / "mine.toml"
    path.write_text(tomli_w.dumps(table | {"camera": "camera.toml", "pool": {"size_m": POOL_M}}), encoding="utf-8")
    return path


def _places_off_m(camera: Camera, depth_m: float) -> Array:
    """Errors of the places that a calibration gives for pixels all over the pool."""
    grid = np.stack(np.meshgrid(np.linspace(-1.2, 1.2, 7), np.linspace(-0.85, 0.85, 5), [depth_m]), axis=-1).reshape(-1, 3)
    lines = rays(camera, project(TRUTH, grid))
    return np.asarray(np.linalg.norm(lines.surface_m + depth_m * lines.water - grid[:, :2], axis=-1))


# --- the whole way


@pytest.mark.long
def test_from_pictures_to_an_experiment(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    assert _calibrate(monkeypatch, lab, out, "--pool-points", lab / "points.toml", "--rate", 25, "--exposure", 0.005) == 0
    output = capsys.readouterr().out
    camera = load_experiment(str(_experiment(tmp_path))).camera
    assert camera.focal_px == pytest.approx(TRUTH.focal_px, rel=0.003)
    assert camera.centre_px == pytest.approx(TRUTH.centre_px, abs=1.5)
    assert (camera.size_px, camera.rate_hz, camera.exposure_s, camera.water_index) == ((480, 360), 25.0, 0.005, 1.333)
    assert camera.position_m == pytest.approx(TRUTH.position_m, abs=0.015)
    # What counts: a pixel is 8 mm here, and places come out to a quarter of that at every depth.
    assert all(_places_off_m(camera, depth_m).max() < 0.002 for depth_m in (0.05, 0.3, 0.7))
    assert "99-empty.png" in output and "no board found" in output
    for name in ("floor 10", "rim 3", "focal_px", "rotation_rad", "Corners fall into"):
        assert name in output
    picture = read_picture(tmp_path / "camera.png")
    assert picture.shape == (360, 2 * 480, 3)
    head = out.read_text(encoding="utf-8").splitlines()[0]
    assert head.startswith("# Found by `localizer calibrate`, 20") and " views, RMS " in head and "9 points" in head


@pytest.mark.long
def test_a_hung_up_camera_keeps_its_lens(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The lens on the bench first, the pose later, and again after somebody bumped into the mast."""
    lens, out = tmp_path / "lens.toml", tmp_path / "camera.toml"
    assert _calibrate(monkeypatch, lab, lens) == 0
    assert f"--lens {lens} --pool-points FILE" in capsys.readouterr().out
    table = tomllib.loads(lens.read_text(encoding="utf-8"))["camera"]
    assert "position_m" not in table
    assert _run(monkeypatch, "calibrate", "--grey", "--lens", lens, "--pool-points", lab / "points.toml", "--out", out) == 0
    camera = load_experiment(str(_experiment(tmp_path))).camera
    assert list(camera.focal_px) == table["focal_px"]
    assert _places_off_m(camera, 0.3).max() < 0.002
    again, arguments = tmp_path / "again.toml", ("calibrate", "--grey", "--pool-points", lab / "points.toml")
    assert _run(monkeypatch, *arguments, "--lens", out, "--rate", 30, "--out", again) == 0
    before, after = (tomllib.loads(path.read_text(encoding="utf-8"))["camera"] for path in (out, again))
    assert after == before | {"rate_hz": 30.0}
    assert _run(monkeypatch, *arguments, "--lens", again, "--out", out) == 0
    assert tomllib.loads(out.read_text(encoding="utf-8"))["camera"] == after  # what is not asked for stays


@pytest.mark.long
def test_points_by_hand_need_no_picture(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    points = [
        {"name": str(i), "pool_m": [*xy, z], "pixel_px": project(TRUTH, np.array([[*xy, z]]))[0].round(2).tolist()}
        for places, z in ((RIM, -0.1), (FLOOR, 0.8))
        for i, xy in places.items()
    ]
    (tmp_path / "points.toml").write_text(tomli_w.dumps({"pool": {"size_m": POOL_M}, "points": points}), encoding="utf-8")
    (tmp_path / "lens.toml").write_text(tomli_w.dumps({"camera": TRUTH.model_dump(mode="json")}), encoding="utf-8")
    arguments = (
        "--lens",
        tmp_path / "lens.toml",
        "--pool-points",
        tmp_path / "points.toml",
        "--out",
        tmp_path / "camera.toml",
    )
    assert _run(monkeypatch, "calibrate", *arguments) == 0
    camera = load_experiment(str(_experiment(tmp_path))).camera
    assert camera.position_m == pytest.approx(TRUTH.position_m, abs=1e-3)
    assert camera.rotation_rad == pytest.approx(TRUTH.rotation_rad, abs=3e-4)


# --- what one channel means


@pytest.mark.parametrize("suffix", sorted({*SUFFIXES} - {".jpg", ".jpeg", ".ppm", ".webp"}))
def test_pictures_of_one_channel_mean_the_same_to_a_source_and_to_the_calibration(tmp_path: Path, suffix: str) -> None:
    """A raw Bayer frame in every kind of file that can hold one: in the localizer's colours, a red floor is red."""
    raw = np.full((64, 80), 20, np.uint8)
    raw[0::2, 0::2] = 200  # red in RGGB
    (tmp_path / "frames").mkdir()
    path = tmp_path / "frames" / f"frame{suffix}"
    assert cv2.imwrite(str(path), raw)
    source = FolderSource(tmp_path / "frames", 20.0, WallClock())
    shot = next(source.frames(Stop(install=False)))
    assert shot is not None
    colours = read_picture(path)
    assert colours == pytest.approx(cv2.cvtColor(shot.pixels, BAYER_TO_BGR), abs=3)
    assert colours[20:40, 20:40].mean(axis=(0, 1)) == pytest.approx([20, 20, 200], abs=6)
    grey = read_picture(path, grey=True)
    assert np.ptp(grey, axis=2).max() <= 3


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_file_that_one_takes_for_a_picture_the_other_takes_too(tmp_path: Path, suffix: str) -> None:
    shape = (64, 80) if suffix == ".pgm" else (64, 80, 3)
    assert cv2.imwrite(str(tmp_path / f"frame{suffix}"), np.full(shape, 90, np.uint8))
    shot = next(FolderSource(tmp_path, 20.0, WallClock()).frames(Stop(install=False)))
    assert shot is not None and shot.pixels.mean() == pytest.approx(90, abs=2)
    ((name, picture),) = pictures([tmp_path], every=1)
    assert name.endswith(suffix) and picture.mean() == pytest.approx(90, abs=2)


def test_a_picture_of_16_bits_is_refused(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "deep.png"), np.full((64, 80), 40000, np.uint16))
    with pytest.raises(ConfigError, match=r"deep\.png: uint16, must be a picture of 8 bits a channel"):
        read_picture(tmp_path / "deep.png")


# --- folders as people have them


def test_a_folder_as_a_camera_and_a_person_leave_it(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Thumbnails, a hidden file that a system left, a broken one, a 16 bit one, one named by another alphabet's bytes, one
    whose note says that the camera was turned: the calibration is that of the good pictures, and the report names the rest."""
    folder = tmp_path / "IMG"
    folder.mkdir()
    for path in sorted((lab / "board").glob("[0-9]*.png")):
        (folder / path.name).write_bytes(path.read_bytes())
    first = cv2.imread(str(folder / "00.png"))
    assert first is not None
    for i in range(3):
        cv2.imwrite(str(folder / f"thumb{i}.jpg"), cv2.resize(first, (160, 120)))
    (folder / "._00.png").write_bytes(b"\x00\x05\x16\x07")
    (folder / "cut.jpg").write_bytes(b"\xff\xd8\xff\xe0")
    (folder / "album.png").mkdir()
    cv2.imwrite(str(folder / "deep.png"), np.zeros((360, 480), np.uint16))
    (folder / "01.png").rename(folder / "\u00b21 \udce4.png")
    (folder / "02.png").unlink()
    (folder / "02.jpg").write_bytes(_turned(cv2.imread(str(lab / "board" / "02.png"), cv2.IMREAD_GRAYSCALE)))
    out = tmp_path / "camera.toml"
    assert _run(monkeypatch, "calibrate", folder, "--board", BOARD, "--grey", "--out", out) == 0
    output = capsys.readouterr().out
    camera = tomllib.loads(out.read_text(encoding="utf-8"))["camera"]
    assert camera["focal_px"] == pytest.approx(TRUTH.focal_px, rel=0.005) and camera["size_px"] == [480, 360]
    for name in ("cut.jpg", "deep.png", "99-empty.png"):
        assert any(name in line and "left out" in line for line in output.splitlines()), name
    assert "._00" not in output and "album" not in output
    (line,) = (line for line in output.splitlines() if "02.jpg" in line)
    assert "left out" not in line, "its note is ignored, as in a video"


def _turned(picture: NDArray[Any] | None) -> bytes:
    """A picture as JPEG with an EXIF note that the camera was held upright."""
    assert picture is not None
    jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 98])[1].tobytes()
    note = b"II*\0" + struct.pack("<IHHHII", 8, 1, 0x112, 3, 1, 6) + bytes(4)
    exif = b"Exif\0\0" + note
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


# --- a lens that should not be used, and a file that is there


def test_a_lens_that_explains_nothing_is_not_written(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Squares of the wrong count: corners are found, and no lens explains them."""
    out, wrong = tmp_path / "camera.toml", BOARD.replace("7x5", "5x7")
    arguments = ("calibrate", lab / "board", "--board", wrong, "--grey", "--out", out)
    assert _run(monkeypatch, *arguments) in (1, 2)
    assert not list(tmp_path.iterdir())
    capsys.readouterr()
    still = tmp_path / "still"
    still.mkdir()
    for i in range(12):
        (still / f"{i}.png").write_bytes((lab / "board" / "03.png").read_bytes())
    assert _run(monkeypatch, "calibrate", still, "--board", BOARD, "--grey", "--out", out) == 2
    assert "found in 1 pictures" in capsys.readouterr().err and not out.exists()


@pytest.mark.long
def test_a_lens_that_is_warned_of_is_written_with_force_only(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of the pictures were squeezed by an editor."""
    folder, out = tmp_path / "board", tmp_path / "camera.toml"
    folder.mkdir()
    for i, path in enumerate(sorted((lab / "board").glob("[01]*.png"))):
        picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert picture is not None
        squeeze = np.array([[0.75 if i % 2 else 1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
        cv2.imwrite(str(folder / path.name), cv2.warpAffine(picture, squeeze, (480, 360), borderValue=90))
    arguments = ("calibrate", folder, "--board", BOARD, "--grey", "--out", out)
    assert _run(monkeypatch, *arguments) == 1
    output = capsys.readouterr()
    assert "px is poor" in output.out and output.err.startswith("No camera file was written: ")
    assert [path.name for path in tmp_path.iterdir()] == ["board"]
    assert _run(monkeypatch, *arguments, "--force") == 0 and out.exists()


def test_a_new_lens_keeps_what_the_file_holds(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    masks = [[[1.0, 2.0], [30.0, 2.0], [30.0, 40.0]]]
    table = TRUTH.model_dump(mode="json") | {"masks_px": masks, "controls": [["gain", 20]], "rate_hz": 33.0, "readout_s": 0.01}
    before = "# hung up in May\n" + tomli_w.dumps({"camera": table | {"focal_px": [1.0, 1.0]}})
    out.write_text(before, encoding="utf-8")
    out.with_suffix(".png").write_bytes(b"a photograph of the pool")  # nobody asked for this name
    assert _calibrate(monkeypatch, lab, out) == 0
    table_after = tomllib.loads(out.read_text(encoding="utf-8"))["camera"]
    assert table_after["focal_px"] == pytest.approx(TRUTH.focal_px, rel=0.005)
    for key in ("masks_px", "controls", "rate_hz", "readout_s", "position_m", "rotation_rad"):
        assert table_after[key] == table[key], key
    assert "WARNING: the pose in it is the earlier one" in capsys.readouterr().out
    (kept,), (photograph,) = tmp_path.glob("camera.toml.2*"), tmp_path.glob("camera.png.2*")
    assert kept.read_text(encoding="utf-8") == before
    assert photograph.read_bytes() == b"a photograph of the pool"


def test_file_that_would_be_lost_is_not_written_over(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "camera.toml"
    for text, complaint in (
        ((EXPERIMENTS / "pool.toml").read_text(encoding="utf-8"), "holds something else than a camera"),
        (tomli_w.dumps({"camera": {"size_px": [640, 480]}}), "holds a camera with pictures of 640x480, these are 480x360"),
        (tomli_w.dumps({"camera": {"size_px": 640}}), "holds a camera with pictures of ?, these are 480x360"),
    ):
        out.write_text(text, encoding="utf-8")
        assert _calibrate(monkeypatch, lab, out) == 2
        assert complaint in capsys.readouterr().err
        assert out.read_text(encoding="utf-8") == text and len(list(tmp_path.iterdir())) == 1


@pytest.mark.long
def test_a_full_disk_leaves_the_old_file(lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither the new camera without its picture, nor the new picture beside the old camera."""
    (tmp_path / "lens.toml").write_text(tomli_w.dumps({"camera": TRUTH.model_dump(mode="json")}), encoding="utf-8")
    out, picture = tmp_path / "camera.toml", tmp_path / "camera.png"
    arguments = ("--grey", "--lens", tmp_path / "lens.toml", "--pool-points", lab / "points.toml", "--out", out)
    assert _run(monkeypatch, "calibrate", *arguments) == 0
    before = out.read_bytes(), picture.read_bytes()
    script = (
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (8000, 8000)); "
        "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); from localizer.__main__ import app; app()"
    )
    command = [sys.executable, "-c", script, "calibrate", *map(str, arguments), "--rate", "50"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "File too large" in done.stderr
    assert (out.read_bytes(), picture.read_bytes()) == before


# --- videos


def test_sharp_frames_of_a_video_are_taken(tmp_path: Path) -> None:
    path = tmp_path / "board.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (160, 120))
    random = np.random.default_rng(1)
    for i in range(23):
        picture = random.integers(0, 256, (120, 160, 3)).astype(np.uint8)
        video.write(picture if i in (3, 17, 21) else cv2.GaussianBlur(picture, (0, 0), 3.0))
    video.release()
    frames = list(pictures([path], every=10))
    assert [name for name, _ in frames] == [f"{path}:3", f"{path}:17", f"{path}:21"]
    assert all(picture.shape == (120, 160, 3) for _, picture in frames)


# --- what is refused, and how


def _files(folder: Path, lab: Path) -> None:
    """Things that go wrong, beside the lab's."""
    (folder / "empty").mkdir()
    (folder / "text.png").write_text("not a picture", encoding="utf-8")
    (folder / "text.avi").write_text("not a video", encoding="utf-8")
    cv2.imwrite(str(folder / "large.png"), np.zeros((720, 960), np.uint8))
    (folder / "two").mkdir()
    for name in ("00.png", "01.png"):
        (folder / "two" / name).write_bytes((lab / "board" / name).read_bytes())
    (folder / "blank").mkdir()
    cv2.imwrite(str(folder / "blank" / "a.png"), np.full((360, 480), 90, np.uint8))
    (folder / "points.toml").write_bytes((lab / "points.toml").read_bytes())
    table = tomllib.loads((lab / "points.toml").read_text(encoding="utf-8"))
    (folder / "few.toml").write_text(tomli_w.dumps(table | {"points": table["points"][:3]}), encoding="utf-8")
    del table["image"]
    (folder / "blind.toml").write_text(tomli_w.dumps(table), encoding="utf-8")
    (folder / "lens.toml").write_text(tomli_w.dumps({"camera": TRUTH.model_dump(mode="json")}), encoding="utf-8")
    (folder / "three.toml").write_text("camera = 3", encoding="utf-8")
    (folder / "broken.toml").write_text("[camera]\nsize_px = [480, 360]\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("", "give either pictures of a board .files, folders, videos., or --lens FILE"),
        ("{lab}/board --lens lens.toml --pool-points points.toml", "give either pictures"),
        ("{lab}/board", "--board: which board do the pictures show"),
        ("{lab}/board --board chess:1", "--board chess:1: not a board"),
        ("two --board chessboard:9x6:0.03", "--board chessboard:9x6:0.03: found in none of 2 pictures"),
        ("nowhere.png --board {board}", "nowhere.png: cannot be read: No such file"),
        ("nowhere --board {board}", "nowhere: cannot be read: No such file"),
        ("empty --board {board}", "empty: no pictures in this folder"),
        ("text.png --board {board}", r"text\.png: not a picture that OpenCV reads .allowed: .*png"),
        ("text.avi --board {board}", r"text\.avi: cannot be read as a video"),
        ("two large.png --board {board}", r"large\.png: 960x720, but most boards are in pictures of 480x360: all must come"),
        ("two --board {board}", r"found in 2 pictures \(two/00\.png, two/01\.png\), at least 5 are needed"),
        ("blank --board {board}", "found in none of 1 pictures"),
        ("{lab}/board --board {board} --out camera.txt", r"--out camera\.txt: must end in \.toml"),
        (
            "{lab}/board --board {board} --out no/camera.toml",
            r"--out no/camera\.toml: must end in \.toml, in a folder that exists",
        ),
        ("--lens lens.toml", "--lens finds nothing new by itself"),
        ("{lab}/board --board {board} --pool-points-image large.png", "--pool-points-image is the picture that --pool-points"),
        ("--lens broken.toml --pool-points points.toml", r"broken\.toml: camera\.focal_px: missing"),
        ("--lens points.toml --pool-points points.toml", r"points\.toml: camera\.size_px: missing"),
        ("--lens three.toml --pool-points points.toml", r"three\.toml: camera = 3: must be a table"),
        ("--lens lens.toml --pool-points few.toml", r"few\.toml: .*points: 3 given, at least 4 are needed"),
        ("--lens lens.toml --pool-points nowhere.toml", r"nowhere\.toml: no such file"),
        ("--lens lens.toml --pool-points points.toml", r"pool\.png: cannot be read: No such file"),
        (
            "--lens lens.toml --pool-points points.toml --out pool.toml",
            r"--out pool\.toml: .*pool\.png: is read by",
        ),
        ("--lens lens.toml --pool-points blind.toml", r"blind\.toml: points: 'rim 0': marker_id = 0: there is no picture"),
        ("--lens lens.toml --pool-points blind.toml --pool-points-image large.png", r"large\.png: 960x720, but the lens was"),
        (
            "--lens lens.toml --pool-points blind.toml --pool-points-image blank/a.png",
            r"0 markers of that id .*found in it: none",
        ),
    ],
)
def test_unusable_picture_is_named(
    arguments: str,
    complaint: str,
    lab: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _files(tmp_path, lab)
    monkeypatch.chdir(tmp_path)
    assert _run(monkeypatch, "calibrate", *arguments.format(lab=lab, board=BOARD).split()) == 2
    output = capsys.readouterr().err
    assert "Traceback" not in output
    with pytest.raises(ConfigError, match=complaint):
        raise ConfigError(output)
    assert not (tmp_path / "camera.toml").exists()


# --- localizer check


def test_check_draws_the_pool_over_a_picture(
    lab: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "camera.toml").write_text(tomli_w.dumps({"camera": TRUTH.model_dump(mode="json")}), encoding="utf-8")
    experiment, out = _experiment(tmp_path), tmp_path / "check.png"
    assert _run(monkeypatch, "check", experiment, "--image", lab / "pool.png", "--depth", 0.8, "--out", out) == 0
    output = capsys.readouterr().out
    for words in ("At 0.8 m depth", "field of view", "one pixel", "1 cm of depth error", str(out)):
        assert words in output
    drawn, plain = read_picture(out).astype(int), read_picture(lab / "pool.png").astype(int)
    changed = np.abs(drawn - plain).max(axis=2) > 30
    u, v = np.rint(project(TRUTH, np.array([[0.5, 0.3, 0.8], [0.4, 0.4, 0.8]]))).astype(int).T
    assert changed[v, u].tolist() == [True, False]  # on the line x = 0.5, and between lines
    assert np.mean(changed) < 0.2


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ("--image {lab}/points.toml", r"points\.toml: not a picture"),
        ("--image nowhere.png", r"nowhere\.png: cannot be read"),
        ("--image large.png", r"large\.png: 960x720, but camera\.size_px of experiment 'pool' is 480x360"),
        ("--out check.xyz", r"check\.xyz: '\.xyz' is no kind of picture .allowed: .*\.png"),
        ("--out no/check.png", r"no/check\.png: cannot be written: No such file"),
        ("--show --image {lab}/pool.png", "give --image, or --live or --show, not both"),
        ("--live --image {lab}/pool.png", "give --image, or --live or --show, not both"),
    ],
)
def test_check_refuses_an_unusable_calibration(
    arguments: str,
    complaint: str,
    lab: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _files(tmp_path, lab)
    (tmp_path / "camera.toml").write_bytes((tmp_path / "lens.toml").read_bytes())
    monkeypatch.chdir(tmp_path)
    assert _run(monkeypatch, "check", _experiment(tmp_path), *arguments.format(lab=lab).split()) == 2
    with pytest.raises(ConfigError, match=complaint):
        raise ConfigError(capsys.readouterr().err)


def test_the_newest_frame_of_the_bus_in_true_colours() -> None:
    hub = MemoryHub()
    with Bus(MemoryTransport(hub)) as camera, Bus(MemoryTransport(hub)) as viewer:
        orange = np.full((64, 96, 3), (20, 120, 230), np.uint8)
        frame = Frame(np.asarray(bayer(orange), dtype=np.uint8))
        later = threading.Timer(0.05, lambda: camera.publish(topics.FRAME, frame, 1))
        later.start()
        picture = LivePictures(viewer).next(Stop(install=False))
        later.join()
    assert picture is not None and picture[20:40, 20:40].reshape(-1, 3).mean(axis=0) == pytest.approx([20, 120, 230], abs=1)


def test_no_frame_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("localizer.calibration.verify.LIVE_PATIENCE_S", 0.01)
    with (
        Bus(MemoryTransport(MemoryHub())) as bus,
        pytest.raises(ConfigError, match=r"--live: no frame on camera/frame within 0\.01 s"),
    ):
        LivePictures(bus).next(Stop(install=False))


def test_the_live_grid_follows_the_camera_until_stopped_and_complains_of_another_size() -> None:
    experiment, hub, stop, complaints = load_experiment("pool"), MemoryHub(), Stop(install=False), []
    width, height = experiment.camera.size_px
    with (
        Bus(MemoryTransport(hub)) as camera,
        Bus(MemoryTransport(hub)) as viewer,
        closing(MjpegServer(0, Stop(install=False))) as page,
    ):
        pictures, number = LivePictures(viewer), 0

        def show() -> None:
            try:
                show_live(experiment, pictures, page, 0.3, stop)
            except ConfigError as error:
                complaints.append(str(error))

        thread = threading.Thread(target=show)
        thread.start()
        u, v = np.rint(project(experiment.camera, np.array([[0.5, 0.3, 0.3], [0.4, 0.4, 0.3]]))).astype(int).T
        for grey in (60, 200):
            camera.publish(topics.FRAME, Frame(np.full((height, width), grey, np.uint8)), grey)
            assert eventually(lambda last=number: (news := page.next(-1)) is not None and news[0] > last)  # type: ignore[misc]
            news = page.next(-1)
            assert news is not None
            number, shown = news[0], cv2.imdecode(np.frombuffer(news[1], np.uint8), cv2.IMREAD_COLOR)
            assert shown is not None and (np.abs(shown[v, u].astype(int) - grey).max(axis=1) > 30).tolist() == [True, False]
        camera.publish(topics.FRAME, Frame(np.full((480, 640), 60, np.uint8)), 300)
        thread.join(timeout=10.0)
    assert complaints == ["the newest frame: 640x480, but camera.size_px of experiment 'pool' is 1280x960"]
