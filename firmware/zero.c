#include "zero.h"

#include <math.h>
#include <string.h>

void zero_begin(struct zero *zero, const struct start *start) {
    memset(zero, 0, sizeof *zero);
    zero->start = *start;
    zero->now = start->zeros;
    zero->has_surface = start->has_zeros;
    zero->is_restarted = !start->is_power_on;
    zero->is_in_question = true; /* until the pressure is known */
}

static void begin_gyro(struct zero *zero) {
    zero->takes_gyro = true;
    zero->rates = 0;
    zero->rates_radps = 0.0f;
}

static bool is_in_air(const struct zero *zero, float pressure_hpa) {
    return pressure_hpa <= (zero->has_surface ? zero->now.surface_hpa + AIR_HPA : AIR_MOST_HPA);
}

enum zero_event zero_pressure(struct zero *zero, float pressure_hpa) {
    zero->has_pressure = isfinite(pressure_hpa);
    if (!zero->has_pressure && zero->purpose == ZERO_TAKE) {
        zero->purpose = ZERO_DONE;
        return ZERO_MISSED;
    }
    if (zero->purpose == ZERO_DONE || !zero->has_pressure)
        return ZERO_SAME;
    zero->pressures_hpa += pressure_hpa;
    if (++zero->pressures < SURFACE_SAMPLES)
        return ZERO_SAME;
    const float mean_hpa = zero->pressures_hpa / SURFACE_SAMPLES;
    const bool judges = zero->purpose == ZERO_JUDGE;
    zero->purpose = ZERO_DONE;
    if (judges && !(zero->start.is_power_on && is_in_air(zero, mean_hpa))) {
        zero->is_restarted = true;
        zero->is_in_question = !zero->has_surface || fabsf(mean_hpa - zero->now.surface_hpa) > AIR_HPA;
        return zero->is_in_question ? ZERO_QUESTIONED : ZERO_SAME;
    }
    if (judges)
        begin_gyro(zero);
    zero->now.surface_hpa = mean_hpa;
    zero->has_surface = true;
    zero->is_in_question = false;
    return ZERO_TAKEN;
}

enum zero_event zero_rate(struct zero *zero, float rate_radps) {
    if (!zero->takes_gyro || !isfinite(rate_radps))
        return ZERO_SAME;
    if (zero->rates > 0 && fabsf(rate_radps - zero->first_radps) > MOVES_RADPS)
        begin_gyro(zero);
    if (zero->rates == 0)
        zero->first_radps = rate_radps;
    zero->rates_radps += rate_radps;
    if (++zero->rates < STILL_SAMPLES)
        return ZERO_SAME;
    zero->now.gyro_bias_radps = zero->rates_radps / STILL_SAMPLES;
    zero->takes_gyro = false;
    return BIAS_TAKEN;
}

bool zero_calibrate(struct zero *zero, bool pressure, bool gyro) {
    if (pressure && !zero->has_pressure)
        return false;
    if (gyro)
        begin_gyro(zero);
    if (pressure) {
        zero->purpose = ZERO_TAKE;
        zero->pressures = 0;
        zero->pressures_hpa = 0.0f;
    }
    if (pressure || gyro)
        return true;
    if (!zero->has_surface)
        return false;
    zero->purpose = ZERO_DONE;
    zero->is_in_question = false;
    return true;
}

void zero_leave_bias(struct zero *zero) { zero->takes_gyro = false; }

float zero_excess_hpa(const struct zero *zero, float pressure_hpa) {
    return zero->has_surface ? pressure_hpa - zero->now.surface_hpa : NAN;
}

uint16_t zero_status(const struct zero *zero) {
    return (uint16_t)(zero->start.causes | (zero->is_restarted ? RESTARTED : 0) |
                      (zero->is_in_question ? ZERO_IN_QUESTION : 0));
}
