/* What the board is asked, and its answers and measurements as messages. The counterpart of sim_bridge/thruster_board/board_link.py. */
#ifndef MESSAGES_H
#define MESSAGES_H

#include <stdbool.h>
#include <stdint.h>

#include "link.h"
#include "rules.h"

enum {
    BOARD_COMPONENT = 1,
    COMPUTER_COMPONENT = 191,
    SIMULATOR_COMPONENT = 200, /* MAV_COMP_ID_IMU: measures for a board in HIL mode */
    COMMAND_CALIBRATE = 241, /* MAV_CMD_PREFLIGHT_CALIBRATION */
    COMMAND_ARM_DISARM = 400,
    COMMAND_REQUEST_MESSAGE = 512
};

enum event_kind {
    EVENT_NONE,
    EVENT_REFUSED, /* for another board, or with a value that no board takes */
    EVENT_OVERRIDE,
    EVENT_ARM,
    EVENT_CALIBRATE,
    EVENT_TIMESYNC,
    EVENT_UNSUPPORTED,
    EVENT_TELL_VERSION,
    EVENT_LIST_PARAMETERS,
    EVENT_READ_PARAMETER,
    EVENT_SET_PARAMETER,
    EVENT_SET_KEY,
    EVENT_SIMULATED_MOTION,
    EVENT_SIMULATED_BATTERY
};

enum { IMU, PRESSURE_SENSOR, CHIPS };
enum chip_state { CHIP_LIVE, CHIP_ABSENT, CHIP_STARTING, CHIP_ASLEEP, CHIP_RESET, CHIP_STUCK };

/* One sample of the sensors; NaN is no measurement. */
struct reading {
    float heading_rad, yaw_rate_radps; /* the rate from a port is the gyro's, with its bias */
    float acceleration_mps2[3]; /* specific force, body frame: at rest (0, 0, -g) */
    float excess_hpa;           /* pressure at the robot's centre minus that at the surface; from a port minus 1013.25 hPa */
    int16_t temperature_cdegc;
    float battery_v;
    uint8_t chip[CHIPS]; /* state of each */
};

struct event {
    enum event_kind kind;
    struct peer from;
    union {
        uint16_t pulses_us[CHANNELS];
        bool arm;
        struct {
            bool pressure, gyro;
        } calibrate; /* neither: what is kept is right */
        int64_t sent_ns;
        uint16_t command;
        struct {
            char name[PARAMETER_NAME];
            int16_t index;
            float value;
            bool is_real32;
        } parameter;
        struct {
            uint8_t secret[KEY_BYTES];
            uint64_t newest;
        } key;
        struct reading motion; /* without battery_v */
        float battery_v;
    };
};

/* `hil`: simulated measurements are taken. */
struct event read_event(const struct frame *frame, uint8_t system, bool hil);

void send_heartbeat(struct link *link, const struct rules *rules, uint16_t status);
void send_attitude(struct link *link, uint32_t board_ms, const struct reading *reading);
void send_imu(struct link *link, uint32_t board_ms, const struct reading *reading);
void send_pressure(struct link *link, uint32_t board_ms, const struct reading *reading);
void send_servo_output(struct link *link, uint32_t board_us, const struct rules *rules);
void send_status(struct link *link, float battery_v, uint8_t charge, uint32_t refused, const struct reading *reading);
void send_battery(struct link *link, float battery_v, uint8_t charge);
void send_parameter(struct link *link, int index, float value);
void send_parameter_error(struct link *link, struct peer asker, const char name[PARAMETER_NAME], int index, uint8_t code);
void send_version(struct link *link);
void send_timesync(struct link *link, int64_t board_ns, int64_t sent_ns);
void send_text(struct link *link, const struct text *text);
void send_acknowledge(struct link *link, struct peer asker, uint16_t command, enum result result);

#endif
