#include "messages.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#include "flash.h"
#include "mavlink.h"

enum { PULSE_LOW_US = 500, PULSE_HIGH_US = 2500, ALL_COMPONENTS = 0, ALL_VALUES = 65535 };
enum { HIL_FIELDS = 0x2E7, MOST_MILLIVOLTS = 60000, WATER_CDEGC = 2000 }; /* HIL_SENSOR_UPDATED_FLAGS of what is read */
enum { GYRO_SENSOR = 0x1, FORCE_SENSOR = 0x2, DEPTH_SENSOR = 0x8, MOTORS = 0x8000, BATTERY_SENSOR = 0x2000000,
       SENSORS = GYRO_SENSOR | FORCE_SENSOR | DEPTH_SENSOR | MOTORS | BATTERY_SENSOR }; /* MAV_SYS_STATUS_SENSOR */
#define SURFACE_HPA 1013.25f
#define STANDARD_GRAVITY_MPS2 9.80665f /* defines the mG of SCALED_IMU */

/* --- what arrives */

#define PAYLOAD_OF(type, frame)                                                                                                 \
    type message;                                                                                                               \
    memset(&message, 0, sizeof message);                                                                                        \
    memcpy(&message, (frame)->payload, (frame)->payload_bytes)

static enum event_kind read_override(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_rc_channels_override_t, frame);
    const uint16_t channels[CHANNELS] = {message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw,
                                         message.chan5_raw, message.chan6_raw, message.chan7_raw, message.chan8_raw};
    for (uint8_t i = 0; i < CHANNELS; i++)
        if (channels[i] != IGNORED && (channels[i] < PULSE_LOW_US || channels[i] > PULSE_HIGH_US))
            return EVENT_REFUSED;
    memcpy(event->pulses_us, channels, sizeof channels);
    return EVENT_OVERRIDE;
}

static float given(float value) { return isnan(value) ? 0.0f : value; } /* in a command NaN is "not given" */

static bool is_flag(float value) { return value == 0.0f || value == 1.0f; }

static enum event_kind read_command(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_command_long_t, frame);
    if (message.command == COMMAND_ARM_DISARM && is_flag(message.param1) && given(message.param2) == 0.0f) {
        event->arm = message.param1 == 1.0f;
        return EVENT_ARM;
    }
    const float none = given(message.param2) + given(message.param4) + given(message.param5) +
                       given(message.param6) + given(message.param7);
    const float gyro = given(message.param1), pressure = given(message.param3);
    if (message.command == COMMAND_CALIBRATE && none == 0.0f && is_flag(gyro) && is_flag(pressure)) {
        event->calibrate.gyro = gyro == 1.0f;
        event->calibrate.pressure = pressure == 1.0f;
        return EVENT_CALIBRATE;
    }
    event->command = message.command;
    const bool version = message.command == COMMAND_REQUEST_MESSAGE && message.param1 == MAVLINK_MSG_ID_AUTOPILOT_VERSION;
    return version ? EVENT_TELL_VERSION : EVENT_UNSUPPORTED;
}

static enum event_kind read_parameter_set(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_param_set_t, frame);
    memcpy(event->parameter.name, message.param_id, PARAMETER_NAME);
    event->parameter.value = message.param_value;
    event->parameter.is_real32 = message.param_type == MAV_PARAM_TYPE_REAL32;
    return EVENT_SET_PARAMETER;
}

static enum event_kind read_parameter_request(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_param_request_read_t, frame);
    memcpy(event->parameter.name, message.param_id, PARAMETER_NAME);
    event->parameter.index = message.param_index;
    return EVENT_READ_PARAMETER;
}

static enum event_kind read_key(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_setup_signing_t, frame);
    uint8_t any = 0;
    for (uint8_t i = 0; i < KEY_BYTES; i++)
        any |= message.secret_key[i];
    if (!any) /* would leave the link unsigned: that is done at the board, not over the link */
        return EVENT_REFUSED;
    memcpy(event->key.secret, message.secret_key, KEY_BYTES);
    event->key.newest = message.initial_timestamp < LATEST_TIMESTAMP ? message.initial_timestamp : LATEST_TIMESTAMP;
    return EVENT_SET_KEY;
}

static enum event_kind read_timesync(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_timesync_t, frame);
    event->sent_ns = message.ts1;
    return message.tc1 == 0 ? EVENT_TIMESYNC : EVENT_NONE;
}

static bool is_within(float value, float most) { return -most <= value && value <= most; } /* no NaN is */

static enum event_kind read_motion(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_hil_sensor_t, frame);
    const bool force = is_within(message.xacc, 300.0f) && is_within(message.yacc, 300.0f) && is_within(message.zacc, 300.0f);
    const bool field = is_within(message.xmag, 10.0f) && is_within(message.ymag, 10.0f) &&
                       !(message.xmag == 0.0f && message.ymag == 0.0f);
    const bool pressure = 500.0f <= message.abs_pressure && message.abs_pressure <= 20000.0f;
    if ((message.fields_updated & HIL_FIELDS) != HIL_FIELDS || !(force && field && pressure && is_within(message.zgyro, 50.0f)))
        return EVENT_REFUSED;
    event->motion = (struct reading){
        .heading_rad = (float)atan2(-(double)message.ymag, (double)message.xmag), /* rounded once, as the reference does */
        .yaw_rate_radps = message.zgyro,
        .acceleration_mps2 = {message.xacc, message.yacc, message.zacc},
        .excess_hpa = message.abs_pressure - SURFACE_HPA,
        .temperature_cdegc = WATER_CDEGC,
    };
    return EVENT_SIMULATED_MOTION;
}

static enum event_kind read_battery(const struct frame *frame, struct event *event) {
    PAYLOAD_OF(mavlink_battery_status_t, frame);
    if (message.id != 0)
        return EVENT_NONE;
    event->battery_v = (float)message.voltages[0] / 1000.0f;
    return message.voltages[0] <= MOST_MILLIVOLTS ? EVENT_SIMULATED_BATTERY : EVENT_REFUSED;
}

/* True if a message is for this board: target system and component are at these places of its payload. */
static bool is_for(const struct frame *frame, uint8_t system, uint8_t at, bool all_components) {
    const uint8_t target = at < frame->payload_bytes ? frame->payload[at] : 0;
    const uint8_t component = at + 1 < frame->payload_bytes ? frame->payload[at + 1] : 0;
    return target == system && (component == BOARD_COMPONENT || (all_components && component == ALL_COMPONENTS));
}

#define TARGET_AT(type) ((uint8_t)offsetof(type, target_system))

struct event read_event(const struct frame *frame, uint8_t system, bool hil) {
    struct event event = {.kind = EVENT_NONE, .from = frame->peer};
    enum event_kind (*read)(const struct frame *, struct event *) = NULL;
    const bool simulated = hil && same_peer(frame->peer, (struct peer){system, SIMULATOR_COMPONENT});
    uint8_t target_at = 0;
    switch (frame->message) {
    case MAVLINK_MSG_ID_TIMESYNC:
        event.kind = read_timesync(frame, &event);
        return event;
    case MAVLINK_MSG_ID_HIL_SENSOR:
        event.kind = simulated ? read_motion(frame, &event) : EVENT_NONE;
        return event;
    case MAVLINK_MSG_ID_BATTERY_STATUS:
        event.kind = simulated ? read_battery(frame, &event) : EVENT_NONE;
        return event;
    case MAVLINK_MSG_ID_RC_CHANNELS_OVERRIDE:
        read = read_override, target_at = TARGET_AT(mavlink_rc_channels_override_t);
        break;
    case MAVLINK_MSG_ID_COMMAND_LONG:
        read = read_command, target_at = TARGET_AT(mavlink_command_long_t);
        break;
    case MAVLINK_MSG_ID_PARAM_SET:
        read = read_parameter_set, target_at = TARGET_AT(mavlink_param_set_t);
        break;
    case MAVLINK_MSG_ID_PARAM_REQUEST_READ:
        read = read_parameter_request, target_at = TARGET_AT(mavlink_param_request_read_t);
        break;
    case MAVLINK_MSG_ID_PARAM_REQUEST_LIST:
        target_at = TARGET_AT(mavlink_param_request_list_t);
        break;
    case MAVLINK_MSG_ID_SETUP_SIGNING:
        read = read_key, target_at = TARGET_AT(mavlink_setup_signing_t);
        break;
    default:
        return event;
    }
    if (!is_for(frame, system, target_at, read != read_override))
        event.kind = EVENT_REFUSED;
    else
        event.kind = read != NULL ? read(frame, &event) : EVENT_LIST_PARAMETERS;
    return event;
}

/* --- what leaves */

#define SEND(link, NAME, message) link_send(link, MAVLINK_MSG_ID_##NAME, MAVLINK_MSG_ID_##NAME##_CRC, message, MAVLINK_MSG_ID_##NAME##_LEN)

static int16_t rounded_int16(float value) { return (int16_t)lrintf(fminf(fmaxf(value, -32768.0f), 32767.0f)); }

static uint16_t millivolt(float voltage_v) {
    return isfinite(voltage_v) ? (uint16_t)lrintf(fminf(fmaxf(voltage_v * 1000.0f, 0.0f), ALL_VALUES - 1.0f)) : 0;
}

static uint16_t at_most_16_bits(uint32_t count) { return count < ALL_VALUES ? (uint16_t)count : ALL_VALUES; }

void send_heartbeat(struct link *link, const struct rules *rules, uint16_t status) {
    const bool armed = rules->armed, healthy = rules->charge < CHARGE_NO_ARM;
    const mavlink_heartbeat_t message = {
        .custom_mode = status,
        .type = MAV_TYPE_SUBMARINE,
        .autopilot = MAV_AUTOPILOT_GENERIC,
        .base_mode = (uint8_t)(MAV_MODE_FLAG_MANUAL_INPUT_ENABLED | (armed ? MAV_MODE_FLAG_SAFETY_ARMED : 0) |
                               (rules_hil(rules) ? MAV_MODE_FLAG_HIL_ENABLED : 0)),
        .system_status = (uint8_t)(!healthy ? MAV_STATE_CRITICAL : armed ? MAV_STATE_ACTIVE : MAV_STATE_STANDBY),
        .mavlink_version = 3,
    };
    SEND(link, HEARTBEAT, &message);
}

void send_attitude(struct link *link, uint32_t board_ms, const struct reading *reading) {
    const mavlink_attitude_t message = {
        .time_boot_ms = board_ms, .yaw = reading->heading_rad, .yawspeed = reading->yaw_rate_radps};
    SEND(link, ATTITUDE, &message);
}

static bool has_force(const struct reading *reading) {
    const float *force = reading->acceleration_mps2;
    return isfinite(force[0]) && isfinite(force[1]) && isfinite(force[2]) && isfinite(reading->yaw_rate_radps);
}

/* Nothing without a measurement: its whole numbers have no NaN. */
void send_imu(struct link *link, uint32_t board_ms, const struct reading *reading) {
    if (!has_force(reading))
        return;
    const float unit_mps2 = STANDARD_GRAVITY_MPS2 / 1000.0f;
    const mavlink_scaled_imu_t message = {
        .time_boot_ms = board_ms,
        .xacc = rounded_int16(reading->acceleration_mps2[0] / unit_mps2),
        .yacc = rounded_int16(reading->acceleration_mps2[1] / unit_mps2),
        .zacc = rounded_int16(reading->acceleration_mps2[2] / unit_mps2),
        .zgyro = rounded_int16(reading->yaw_rate_radps * 1000.0f),
    };
    SEND(link, SCALED_IMU, &message);
}

void send_pressure(struct link *link, uint32_t board_ms, const struct reading *reading) {
    const mavlink_scaled_pressure2_t message = {
        .time_boot_ms = board_ms,
        .press_abs = SURFACE_HPA + reading->excess_hpa,
        .press_diff = reading->excess_hpa,
        .temperature = reading->temperature_cdegc,
    };
    SEND(link, SCALED_PRESSURE2, &message);
}

void send_servo_output(struct link *link, uint32_t board_us, const struct rules *rules) {
    const mavlink_servo_output_raw_t message = {
        .time_usec = board_us,
        .servo1_raw = rules_echo_us(rules, 0),
        .servo2_raw = rules_echo_us(rules, 1),
        .servo3_raw = rules_echo_us(rules, 2),
        .servo4_raw = rules_echo_us(rules, 3),
        .servo5_raw = rules_echo_us(rules, 4),
        .servo6_raw = rules_echo_us(rules, 5),
        .servo7_raw = rules_echo_us(rules, 6),
        .servo8_raw = rules_echo_us(rules, 7),
    };
    SEND(link, SERVO_OUTPUT_RAW, &message);
}

/* The bits of what is healthy: the battery, and each sensor that measures. `reading` NULL: none does. */
static uint32_t healthy(uint8_t charge, const struct reading *reading) {
    uint32_t health = MOTORS | (charge == CHARGE_GOOD ? BATTERY_SENSOR : 0u);
    if (reading == NULL)
        return health;
    return health | (isfinite(reading->yaw_rate_radps) ? GYRO_SENSOR : 0u) |
           (has_force(reading) ? FORCE_SENSOR : 0u) | (isfinite(reading->excess_hpa) ? DEPTH_SENSOR : 0u);
}

void send_status(struct link *link, float battery_v, uint8_t charge, uint32_t refused, const struct reading *reading) {
    const mavlink_sys_status_t message = {
        .onboard_control_sensors_present = SENSORS,
        .onboard_control_sensors_enabled = SENSORS,
        .onboard_control_sensors_health = healthy(charge, reading),
        .voltage_battery = millivolt(battery_v),
        .current_battery = -1,
        .battery_remaining = -1,
        .errors_comm = at_most_16_bits(link->count.bad),
        .errors_count1 = at_most_16_bits(refused),
        .errors_count2 = at_most_16_bits(link->count.unauthentic),
    };
    SEND(link, SYS_STATUS, &message);
}

void send_battery(struct link *link, float battery_v, uint8_t charge) {
    mavlink_battery_status_t message = {
        .battery_function = MAV_BATTERY_FUNCTION_ALL,
        .type = MAV_BATTERY_TYPE_LIPO,
        .temperature = INT16_MAX, /* not known */
        .current_battery = -1,
        .current_consumed = -1,
        .energy_consumed = -1,
        .battery_remaining = -1,
        .charge_state = (uint8_t)(MAV_BATTERY_CHARGE_STATE_OK + charge),
    };
    memset(message.voltages, 0xFF, sizeof message.voltages);
    message.voltages[0] = millivolt(battery_v);
    SEND(link, BATTERY_STATUS, &message);
}

void send_parameter(struct link *link, int index, float value) {
    mavlink_param_value_t message = {
        .param_value = value, .param_count = PARAMETERS, .param_index = (uint16_t)index, .param_type = MAV_PARAM_TYPE_REAL32};
    const struct parameter_row row = parameter_row(index);
    memcpy(message.param_id, row.name, sizeof message.param_id);
    SEND(link, PARAM_VALUE, &message);
}

void send_parameter_error(struct link *link, struct peer asker, const char name[PARAMETER_NAME], int index, uint8_t code) {
    mavlink_param_error_t message = {.param_index = (int16_t)index,
                                     .target_system = asker.system,
                                     .target_component = asker.component,
                                     .error = code};
    for (uint8_t i = 0; i < PARAMETER_NAME && name[i] != '\0'; i++)
        message.param_id[i] = (name[i] & 0x80) ? '?' : name[i];
    SEND(link, PARAM_ERROR, &message);
}

void send_version(struct link *link) {
    const mavlink_autopilot_version_t message = {
        .capabilities = MAV_PROTOCOL_CAPABILITY_MAVLINK2 | MAV_PROTOCOL_CAPABILITY_PARAM_FLOAT |
                        MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST,
        .uid = link->me.system,
    };
    SEND(link, AUTOPILOT_VERSION, &message);
}

void send_timesync(struct link *link, int64_t board_ns, int64_t sent_ns) {
    const mavlink_timesync_t message = {.tc1 = board_ns, .ts1 = sent_ns};
    SEND(link, TIMESYNC, &message);
}

void send_text(struct link *link, const struct text *text) {
    mavlink_statustext_t message = {.severity = text->severity};
    memcpy(message.text, text->characters, text->length);
    SEND(link, STATUSTEXT, &message);
}

void send_acknowledge(struct link *link, struct peer asker, uint16_t command, enum result result) {
    const mavlink_command_ack_t message = {.command = command,
                                           .result = (uint8_t)result,
                                           .target_system = asker.system,
                                           .target_component = asker.component};
    SEND(link, COMMAND_ACK, &message);
}
