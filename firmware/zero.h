/* The zeros of the sensors, and how this life of the board began: docs/board.md, "After a reset". Pure: no clock, no sensors.
The counterpart of sim_bridge/thruster_board/sensor_zero.py.

Surface pressure and gyro bias survive every reset except a power-on in air. In air is where the pressure is at most AIR_HPA above
the kept surface pressure. */
#ifndef ZERO_H
#define ZERO_H

#include <stdbool.h>
#include <stdint.h>

enum { /* causes of a reset, as the ATmega's MCUSR has them; 0: unknown, a bootloader has cleared them */
    RESET_POWER_ON = 0x01,
    RESET_PIN = 0x02,
    RESET_BROWN_OUT = 0x04,
    RESET_WATCHDOG = 0x08,
};
enum { RESTARTED = 0x100, ZERO_IN_QUESTION = 0x200 }; /* with the causes in HEARTBEAT's custom_mode */
enum { SURFACE_SAMPLES = 8, STILL_SAMPLES = 64 };     /* means of so many are exact in single precision, as in the reference */
#define MOVES_RADPS 0.0625f /* two rates of a robot at rest are less apart: the noise is 0.001 */
#define AIR_HPA 10.0f       /* 0.1 m of water; the air's own pressure rarely rises by more between two days */
#define AIR_MOST_HPA 46.75f /* without a kept surface pressure: 1060 hPa, more than the air ever has */

/* What is kept without power. Pressures here are those above 1013.25 hPa. */
struct zeros {
    float surface_hpa, gyro_bias_radps;
};

/* How this life of the board began. */
struct start {
    uint8_t causes;
    bool is_power_on; /* no RAM outlived it */
    bool has_zeros;
    struct zeros zeros;
};

enum zero_purpose { ZERO_JUDGE, ZERO_TAKE, ZERO_DONE }; /* what the pressures that come are for */
enum zero_event { ZERO_SAME, ZERO_TAKEN, ZERO_QUESTIONED, BIAS_TAKEN, ZERO_MISSED };

struct zero {
    struct start start;
    struct zeros now;
    bool has_surface, has_pressure, takes_gyro, is_restarted, is_in_question;
    uint8_t purpose, pressures, rates;
    float pressures_hpa, rates_radps; /* sums */
    float first_radps;                /* of these rates */
};

void zero_begin(struct zero *zero, const struct start *start);
enum zero_event zero_pressure(struct zero *zero, float pressure_hpa); /* a measurement above 1013.25 hPa, or NaN */
enum zero_event zero_rate(struct zero *zero, float rate_radps);       /* a measurement of the gyro, with its bias */
/* For a person: what is kept is right, or the zeros are taken anew where the robot is. False if nothing is kept, or
the pressure is not measured now: taken later, it may be that of water. */
bool zero_calibrate(struct zero *zero, bool pressure, bool gyro);
void zero_leave_bias(struct zero *zero); /* the robot no longer lies still */
float zero_excess_hpa(const struct zero *zero, float pressure_hpa); /* NaN without a surface pressure */
uint16_t zero_status(const struct zero *zero);

#endif
