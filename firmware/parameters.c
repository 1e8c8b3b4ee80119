#include "parameters.h"

#include <math.h>
#include <string.h>

#include "flash.h"

static const struct parameter_row TABLE[PARAMETERS] PROGMEM = {
#define PARAMETER(name, low, high, whole, standard, bounds) {#name, bounds, low, high, standard, whole},
#include "parameter_table.h"
#undef PARAMETER
};

struct parameter_row parameter_row(int index) {
    struct parameter_row row;
    memcpy_P(&row, &TABLE[index], sizeof row);
    return row;
}

void parameters_standard(struct parameters *parameters) {
    for (int i = 0; i < PARAMETERS; i++)
        parameters->value[i] = parameter_row(i).standard;
}

int parameter_named(const char name[PARAMETER_NAME]) {
    char padded[PARAMETER_NAME + 1] = "";
    strncpy(padded, name, PARAMETER_NAME);
    for (int i = 0; i < PARAMETERS; i++)
        if (memcmp_P(padded, TABLE[i].name, sizeof padded) == 0)
            return i;
    return NO_PARAMETER;
}

static bool in_range(int index, float value) {
    const struct parameter_row row = parameter_row(index);
    return row.low <= value && value <= row.high && (!row.whole || value == truncf(value)); /* no NaN passes */
}

/* True if a pulse lies between the lowest and the highest at which this curve is 0 N. */
static bool in_dead_zone(const float *value, float pulse_us) {
    bool reached = false, left = true;
    for (int i = CRV01_US; i < PARAMETERS; i += 2) { /* the pulses rise */
        if (value[i + 1] != 0.0f)
            continue;
        reached = reached || value[i] <= pulse_us;
        left = value[i] < pulse_us;
    }
    return reached && !left;
}

bool is_neutral_pulse(const struct parameters *parameters, uint16_t pulse_us) {
    return in_dead_zone(parameters->value, pulse_us);
}

/* True if the outputs that drive a thruster of the vehicle for which the firmware was built are neutral by the present curve and
by that vehicle's own: a wrong curve must not make a disarmed board push. (A count below the vehicle's, which would have a thruster
hold its thrust, is out of range.) */
static bool has_safe_neutral(const float *value) {
    struct parameters built;
    parameters_standard(&built);
    for (int i = 0; i < value[THR_COUNT]; i++) {
        const float pulse_us = value[THR_NEUTRAL_US] + value[THR1_TRIM_US + i];
        if (!in_dead_zone(value, pulse_us) || !in_dead_zone(built.value, pulse_us))
            return false;
    }
    return in_dead_zone(value, value[THR_NEUTRAL_US]) && in_dead_zone(built.value, value[THR_NEUTRAL_US]);
}

static bool is_consistent(const float *value) {
    for (int i = CRV01_US; i + 2 < PARAMETERS; i += 2)
        if (!(value[i] < value[i + 2] && value[i + 1] <= value[i + 3]))
            return false;
    const float neutral_us = value[THR_NEUTRAL_US];
    return value[CRV01_US] <= value[THR_MIN_US] && value[THR_MIN_US] < neutral_us && neutral_us < value[THR_MAX_US] &&
           value[THR_MAX_US] <= value[PARAMETERS - 2] && value[CRV01_N] < 0.0f && value[PARAMETERS - 1] > 0.0f &&
           has_safe_neutral(value) &&
           value[BAT_WARN_V] > value[BAT_NOARM_V] && value[BAT_NOARM_V] > value[BAT_NEUTRAL_V] &&
           value[ANK_MIN_US] < value[ANK_MAX_US] && value[HIL_OUTPUTS] <= value[HIL_MODE];
}

enum refusal parameters_change(struct parameters *parameters, int index, float value) {
    if (index < 0)
        return UNKNOWN_PARAMETER;
    if (!in_range(index, value))
        return OUT_OF_RANGE;
    const float before = parameters->value[index];
    parameters->value[index] = value;
    if (is_consistent(parameters->value))
        return TAKEN;
    parameters->value[index] = before;
    return INCONSISTENT;
}

static bool are_valid(const struct parameters *parameters) {
    for (int i = 0; i < PARAMETERS; i++)
        if (!in_range(i, parameters->value[i]))
            return false;
    return is_consistent(parameters->value);
}

void parameters_restore(struct parameters *parameters, const struct parameters *kept) {
    *parameters = *kept;
    parameters->value[HIL_MODE] = parameters->value[HIL_OUTPUTS] = 0.0f;
    if (!are_valid(parameters))
        parameters_standard(parameters);
}
