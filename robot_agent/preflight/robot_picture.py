"""The robot from above, drawn in characters, with the part of it that is about to move. Pure."""

from robot_agent.safety.thruster_selftest import THRUSTERS
from wire.config.vehicle import Vehicle

CORNERS = ((True, False), (True, True), (False, False), (False, True))  # ahead, to starboard: as they are drawn


def part(channel: int) -> str:
    """Name of what an output (from 0) moves: thruster 1 to 4, ankle 1 to 4."""
    return f"{'thruster' if channel < THRUSTERS else 'ankle'} {channel % THRUSTERS + 1}"


def place(vehicle: Vehicle, channel: int) -> str:
    """Place of an output's leg: front left, and so on."""
    x, y = vehicle.legs.position_m[channel % THRUSTERS]
    return f"{'front' if x > 0.0 else 'rear'} {'right' if y > 0.0 else 'left'}"


def picture(vehicle: Vehicle, channel: int) -> str:
    """The robot from above, ahead is up. `[*]` is the leg of the output; the numbers are those of the legs."""
    leg_at = {(x > 0.0, y > 0.0): leg for leg, (x, y) in enumerate(vehicle.legs.position_m)}
    marks = {leg: "[*]" if leg == channel % THRUSTERS else "[ ]" for leg in range(THRUSTERS)}
    front_left, front_right, rear_left, rear_right = (leg_at[corner] for corner in CORNERS)
    return "\n".join(
        (
            "              ahead",
            "                ^",
            f"  {front_left + 1} {marks[front_left]}----.-----.----{marks[front_right]} {front_right + 1}",
            "           |     |",
            "           |     |",
            f"  {rear_left + 1} {marks[rear_left]}----'-----'----{marks[rear_right]} {rear_right + 1}",
        )
    )
