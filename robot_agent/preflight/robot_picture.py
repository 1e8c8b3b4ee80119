"""The robot from above, drawn in characters, with the part of it that is about to move. Pure."""

from shoal.config.vehicle import LEGS, Vehicle

CORNERS = ((True, False), (True, True), (False, False), (False, True))  # ahead, to starboard: as they are drawn


def part(vehicle: Vehicle, channel: int) -> str:
    """Name of what an output (from 0) moves: thruster 1 to 4, ankle 1 to 4; or thruster 1 to 8."""
    thrusters = vehicle.thruster_count
    return f"thruster {channel + 1}" if channel < thrusters else f"ankle {channel - thrusters + 1}"


def place(vehicle: Vehicle, channel: int) -> str:
    """Place of an output's leg or thruster: front left, and so on."""
    return vehicle.thruster_name(channel % vehicle.thruster_count)


def picture(vehicle: Vehicle, channel: int) -> str:
    """The robot from above, ahead is up. `[*]` is the leg of the output; the numbers are those of the legs. Nothing for a
    vehicle without legs."""
    if vehicle.legs is None:
        return ""
    leg_at = {(x > 0.0, y > 0.0): leg for leg, (x, y) in enumerate(vehicle.legs.position_m)}
    marks = {leg: "[*]" if leg == channel % LEGS else "[ ]" for leg in range(LEGS)}
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
