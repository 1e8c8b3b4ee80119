"""Messages from the page to the station: small JSON texts, checked field by field, refused if they do not fit. Pure."""

from typing import Annotated, Any, Literal

import msgspec

from groundstation.mission.state_machine import FLEET_REQUESTS, WATER, WITH_DETAILS, order_name
from shoal.config.formation_shapes import Shape

MOST_ISLANDS = 100
MOST_PLACES = 50  # of a way that is clicked on the map
LONGEST_BYTES = 64 * 1024  # of one text: an edit of 49 nodes and 200 waypoints is 12 kB

Count = Annotated[int, msgspec.Meta(ge=0, le=2**53)]
Metres = Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)]
Typed = Annotated[float, msgspec.Meta(ge=-1e12, le=1e12)]  # by a person, key by key: the station says what is allowed
RobotId = Annotated[int, msgspec.Meta(ge=0, le=999)]
Velocity = Annotated[float, msgspec.Meta(ge=-10, le=10)]  # m/s or rad/s; the robot limits it
EditedId = Annotated[int, msgspec.Meta(ge=1, le=49)]
Vec2 = tuple[Metres, Metres]
Vec3 = tuple[Metres, Metres, Metres]
ORDERS = (*FLEET_REQUESTS, *map(order_name, (*WITH_DETAILS, *WATER)), "fault")
DetailText = Annotated[str, msgspec.Meta(max_length=48 * 1024)]  # a form as read_form reads it, a fault, an experiment
CameraName = Annotated[str, msgspec.Meta(max_length=64)]
RunName = Annotated[str, msgspec.Meta(min_length=1, max_length=255)]  # of its folder
OrderName = Annotated[str, msgspec.Meta(pattern=rf"\A(?:{'|'.join(ORDERS)})\Z")]


class Hello(msgspec.Struct, tag_field="kind", tag="hello", forbid_unknown_fields=True, frozen=True):
    """The first text of a connection. The token is empty on loopback."""

    token: Annotated[str, msgspec.Meta(max_length=256)] = ""
    page: Annotated[str, msgspec.Meta(max_length=64)] = ""  # drawn by each page: one that comes back is the same
    camera: CameraName = ""  # whose picture to show; empty, or one that there is not: the first


class Ack(msgspec.Struct, tag_field="kind", tag="ack", forbid_unknown_fields=True, frozen=True):
    """Frame `n` and all before it have been taken in."""

    n: Count


class Take(msgspec.Struct, tag_field="kind", tag="take", forbid_unknown_fields=True, frozen=True):
    """Ask for control. With `over`, take it from the page that has it."""

    over: bool = False


class Release(msgspec.Struct, tag_field="kind", tag="release", forbid_unknown_fields=True, frozen=True):
    """Give control back."""


class Edit(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Changes of pool, islands, path, formation and robots. What is None stays as it is."""

    pool_m: Vec3 | None = None
    islands_m: Annotated[list[Vec3], msgspec.Meta(max_length=MOST_ISLANDS)] | None = None  # x, y, radius of each
    kind: Literal["circle", "waypoints", "route"] | None = None  # another path: it has only the keys that are given here
    points_m: Annotated[list[Vec2], msgspec.Meta(min_length=2, max_length=200)] | None = None  # waypoints, or a route's places
    start_index: Annotated[int, msgspec.Meta(ge=0, le=199)] | None = None  # of the waypoint at which the run begins
    speed_mps: Typed | None = None
    laps: Annotated[int, msgspec.Meta(ge=0, le=2**31)] | None = None  # of waypoints, as what follows
    corner: Literal["smooth", "round", "stop"] | None = None
    corner_m: Typed | None = None
    stop: bool | None = None
    diameter_m: Typed | None = None
    lap_s: Typed | None = None
    depth_m: Typed | None = None
    duration_s: Typed | None = None
    mode: Literal["translate", "rotate"] | None = None
    scale: Typed | None = None
    robots: Annotated[list[EditedId], msgspec.Meta(min_length=1, max_length=49)] | None = None  # all of them, in this order
    nodes_m: Annotated[dict[EditedId, Vec3], msgspec.Meta(max_length=49)] | None = None
    shape: Shape | None = None  # gives every robot its node instead
    spacing_m: Typed | None = None


class OrderRequest(msgspec.Struct, tag_field="kind", tag="order", forbid_unknown_fields=True, frozen=True):
    """An order for the whole fleet, or for `robot`; `n` comes back with the answer. `via_m`: places of a `go`."""

    n: Count
    order: OrderName
    via_m: Annotated[list[Vec2], msgspec.Meta(max_length=MOST_PLACES)] = []
    robot: RobotId = 0
    text: DetailText = ""  # form of a `formation`, what breaks of a `fault`, of a `path` an experiment's name or its TOML
    edit: Edit | None = None  # of a `path`: the running experiment with this edit, in place of a text
    seen_ms: Count = 0  # `clock_ms` of the newest state that the page had: an order that was long on its way is none


class DriveRequest(msgspec.Struct, tag_field="kind", tag="drive", forbid_unknown_fields=True, frozen=True):
    """Velocity of one robot in its body frame, now; the page says it again while a key is held. All zeros: hold."""

    robot: RobotId
    surge_mps: Velocity
    heave_mps: Velocity
    yaw_rate_radps: Velocity
    seen_ms: Count = 0  # as of an order


class TuneRequest(msgspec.Struct, tag_field="kind", tag="tune", forbid_unknown_fields=True, frozen=True):
    """Other gains for the whole fleet: those that are named; none: those before. `n` comes back with the answer."""

    n: Count
    values: Annotated[dict[Annotated[str, msgspec.Meta(max_length=64)], Typed], msgspec.Meta(max_length=64)] | None = None
    next_lap: bool = False
    seen_ms: Count = 0  # as of an order


class PreviewEdit(msgspec.Struct, tag_field="kind", tag="try", forbid_unknown_fields=True, frozen=True):
    """Plan an edit with the real planner and tell what comes of it; nothing flies."""

    n: Count
    edit: Edit


class PreviewFlight(msgspec.Struct, tag_field="kind", tag="draft", forbid_unknown_fields=True, frozen=True):
    """Plan another form or path of the formation and tell what comes of it; nothing flies it."""

    n: Count
    order: Literal["formation", "path"]
    text: DetailText  # as of an order


class Save(msgspec.Struct, tag_field="kind", tag="save", forbid_unknown_fields=True, frozen=True):
    """Write an edit that can be flown into an experiment file of this name."""

    n: Count
    edit: Edit
    name: Annotated[str, msgspec.Meta(pattern=r"\A[a-z0-9][a-z0-9-]{0,63}\Z")]


class ChooseCamera(msgspec.Struct, tag_field="kind", tag="camera", forbid_unknown_fields=True, frozen=True):
    """Show this page the picture of another camera."""

    camera: CameraName


class Remark(msgspec.Struct, tag_field="kind", tag="remark", forbid_unknown_fields=True, frozen=True):
    """A person's line for the log."""

    text: Annotated[str, msgspec.Meta(min_length=1, max_length=200)]


class ListRuns(msgspec.Struct, tag_field="kind", tag="runs", forbid_unknown_fields=True, frozen=True):
    """Tell which runs there are."""


class LabelRun(msgspec.Struct, tag_field="kind", tag="label", forbid_unknown_fields=True, frozen=True):
    """Give a run a name and tags."""

    run: RunName
    name: Annotated[str, msgspec.Meta(max_length=100)]
    tags: Annotated[list[Annotated[str, msgspec.Meta(max_length=40)]], msgspec.Meta(max_length=20)]


class DeleteRun(msgspec.Struct, tag_field="kind", tag="delete", forbid_unknown_fields=True, frozen=True):
    """Delete a run's folder."""

    run: RunName


class Seek(msgspec.Struct, tag_field="kind", tag="seek", forbid_unknown_fields=True, frozen=True):
    """Replay: go to this time of the run, at this pace; 0 is a pause."""

    time_s: Annotated[float, msgspec.Meta(ge=0, le=1e6)] | None = None
    rate: Annotated[float, msgspec.Meta(ge=0, le=64)] | None = None


class AfterRun(msgspec.Struct, tag_field="kind", tag="after", forbid_unknown_fields=True, frozen=True):
    """After an ended run: fly it again, fly an edit of it, or close the page's server. `n` comes back with the answer."""

    n: Count
    what: Literal["again", "edited", "close"]
    edit: Edit | None = None  # with "edited"


OfRuns = ListRuns | LabelRun | DeleteRun
Request = (
    Hello
    | Ack
    | Take
    | Release
    | OrderRequest
    | DriveRequest
    | TuneRequest
    | PreviewEdit
    | PreviewFlight
    | Save
    | ChooseCamera
    | Remark
    | Seek
    | AfterRun
    | OfRuns
)
_DECODER = msgspec.json.Decoder(Request)


class _Numbered(msgspec.Struct, frozen=True):
    """The part of a request by which its answer finds the page's question."""

    kind: str
    n: Count


_ANSWERS = {"order": "reply", "tune": "reply", "try": "tried", "draft": "drafted", "save": "saved", "after": "chosen"}


def _refusal(text: str | bytes, reason: str) -> dict[str, Any] | None:
    """The answer to a request of ours with a value that is not allowed; None for any other text."""
    try:
        request = msgspec.json.decode(text, type=_Numbered)
    except (msgspec.DecodeError, UnicodeError, RecursionError):
        return None
    if request.kind not in _ANSWERS:
        return None
    answer = {"k": _ANSWERS[request.kind], "n": request.n, "order": request.kind, "request": 0}
    return answer | {"ok": False, "reason": reason, "problems": [reason]}


class BadRequest(Exception):
    """A text that is no request; says what is wrong with it. `answer`: for the page, where a person may have typed it."""

    def __init__(self, reason: str, answer: dict[str, Any] | None = None) -> None:
        super().__init__(reason)
        self.answer = answer


def read_request(text: str | bytes) -> Request:
    """The request in a text. Raises BadRequest, and nothing else, for any text."""
    if len(text) > LONGEST_BYTES:
        raise BadRequest(f"{len(text)} bytes, more than the allowed {LONGEST_BYTES}")
    try:
        request: Request = _DECODER.decode(text)
        return request
    except (msgspec.DecodeError, UnicodeError, RecursionError) as error:
        raise BadRequest(str(error), _refusal(text, str(error))) from None
