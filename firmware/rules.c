#include "rules.h"

#include <math.h>
#include <string.h>

#include "flash.h"

#define BATTERY_FILTER_S 1.0f /* time constant of the voltage filter: thrust lowers the voltage for moments */

/* Take over the parameters of the outputs. They are whole. */
static void set_pins(struct rules *rules) {
    const float *value = rules->parameters.value;
    rules->thrusters = (uint8_t)value[THR_COUNT];
    rules->is_held = rules_hil(rules) && value[HIL_OUTPUTS] == 0.0f;
    for (uint8_t i = 0; i < CHANNELS; i++) {
        struct pin *pin = &rules->pin[i];
        const float *limit_us = value + (i < rules->thrusters ? THR_MIN_US : ANK_MIN_US); /* and behind it the highest */
        pin->lowest_us = (uint16_t)limit_us[0];
        pin->highest_us = (uint16_t)limit_us[1];
        pin->rest_us = i < rules->thrusters ? (uint16_t)value[THR_NEUTRAL_US] : (uint16_t)((pin->lowest_us + pin->highest_us) / 2);
        pin->trim_us = (int16_t)value[THR1_TRIM_US + i];
    }
}

void rules_begin(struct rules *rules, struct peer computer) {
    rules->computer = computer;
    set_pins(rules);
    for (uint8_t i = 0; i < CHANNELS; i++)
        rules->echo_us[i] = rules->pin[i].rest_us;
}

bool rules_hil(const struct rules *rules) { return rules->parameters.value[HIL_MODE] != 0.0f; }

uint16_t rules_echo_us(const struct rules *rules, uint8_t channel) {
    return (uint16_t)lrintf(rules->echo_us[channel]);
}

uint16_t rules_output_us(const struct rules *rules, uint8_t channel) {
    const struct pin *pin = &rules->pin[channel];
    const uint16_t pulse_us = rules->is_held ? pin->rest_us : rules_echo_us(rules, channel);
    const uint16_t trimmed_us = (uint16_t)(pulse_us + (uint16_t)pin->trim_us); /* modulo 2^16; at least 400 */
    if (trimmed_us < pin->lowest_us)
        return pin->lowest_us;
    return trimmed_us < pin->highest_us ? trimmed_us : pin->highest_us;
}

static struct text *say(struct rules *rules, enum severity severity) {
    if (rules->texts == TEXTS) { /* more than one step can cause: the oldest goes */
        memmove(rules->text, rules->text + 1, sizeof rules->text - sizeof rules->text[0]);
        rules->texts--;
    }
    struct text *text = &rules->text[rules->texts++];
    text_begin(text, severity);
    return text;
}

void rules_say(struct rules *rules, enum severity severity, const char *words) { text_flash(say(rules, severity), words); }

static void disarm(struct rules *rules, enum severity severity, const char *reason) {
    rules->armed = false;
    rules_say(rules, severity, reason);
}

/* --- what arrives */

static bool is_allowed(const struct rules *rules, const uint16_t pulses_us[CHANNELS]) {
    for (uint8_t i = 0; i < CHANNELS; i++) {
        const struct pin *pin = &rules->pin[i];
        const bool is_ignored = i >= rules->thrusters && pulses_us[i] == IGNORED;
        if (!is_ignored && !(pin->lowest_us <= pulses_us[i] && pulses_us[i] <= pin->highest_us))
            return false;
    }
    return true;
}

bool rules_override(struct rules *rules, struct peer sender, const uint16_t pulses_us[CHANNELS], uint64_t now_us) {
    if (!same_peer(sender, rules->computer) || !is_allowed(rules, pulses_us)) {
        rules->overrides_refused++;
        return false;
    }
    memcpy(rules->command_us, pulses_us, sizeof rules->command_us);
    rules->command_at_us = now_us;
    rules->has_command = true;
    return true;
}

static bool is_stale(const struct rules *rules, uint64_t now_us) {
    const uint32_t age_us = (uint32_t)rules->parameters.value[CMD_AGE_MS] * 1000u;
    return !rules->has_command || (now_us > rules->command_at_us && now_us - rules->command_at_us > age_us);
}

static bool is_neutral_command(const struct rules *rules) {
    for (uint8_t i = 0; i < rules->thrusters; i++)
        if (!is_neutral_pulse(&rules->parameters, rules->command_us[i]))
            return false;
    return true;
}

static const char *arming_refusal(const struct rules *rules, uint64_t now_us) {
    if (is_stale(rules, now_us))
        return PSTR("not armed: no override is arriving");
    if (!is_neutral_command(rules))
        return PSTR("not armed: thruster pulses are not neutral");
    if (rules->charge >= CHARGE_NO_ARM)
        return PSTR("not armed: battery low");
    return NULL;
}

enum result rules_arm(struct rules *rules, bool wanted, uint64_t now_us) {
    if (!wanted) {
        if (rules->armed)
            disarm(rules, SAY_INFO, PSTR("disarmed"));
        return ACCEPTED;
    }
    if (rules->armed)
        return ACCEPTED;
    const char *reason = arming_refusal(rules, now_us);
    if (reason != NULL) {
        text_flash(say(rules, SAY_WARNING), reason);
        return REJECTED;
    }
    rules->armed = true;
    text_flash(say(rules, SAY_INFO), PSTR("armed"));
    return ACCEPTED;
}

enum refusal rules_change(struct rules *rules, int parameter, float value) {
    if (parameter >= 0 && rules->armed)
        return REFUSED_ARMED;
    const bool was_hil = rules_hil(rules);
    const enum refusal refusal = parameters_change(&rules->parameters, parameter, value);
    if (refusal == TAKEN) {
        rules->has_command = false; /* it was checked against the old values */
        set_pins(rules);
    }
    if (rules_hil(rules) != was_hil) { /* the voltage so far is another battery's */
        rules->has_voltage = false;
        rules->charge = CHARGE_GOOD;
    }
    return refusal;
}

bool rules_take_key(struct rules *rules) {
    if (rules->armed)
        return false;
    rules->has_command = false;
    return true;
}

static void say_charge(struct rules *rules, enum severity severity, float voltage_v) {
    static const char LEVELS[][8] PROGMEM = {"GOOD", "WARN", "NO_ARM", "NEUTRAL"};
    const uint32_t tenths = (uint32_t)lrintf(fminf(fmaxf(voltage_v, 0.0f), 1e6f) * 10.0f);
    struct text *text = say(rules, severity);
    text_flash(text, PSTR("battery "));
    text_flash(text, LEVELS[rules->charge]);
    text_flash(text, PSTR(": "));
    text_number(text, tenths / 10);
    text_flash(text, PSTR("."));
    text_number(text, tenths % 10);
    text_flash(text, PSTR(" V"));
}

/* A level is entered below its threshold, and left well above it. */
void rules_battery(struct rules *rules, float voltage_v, float elapsed_s) {
    const float *threshold_v = rules->parameters.value + BAT_WARN_V;
    const float hysteresis_v = rules->parameters.value[BAT_HYST_V];
    if (!isfinite(voltage_v))
        voltage_v = 0.0f;
    if (!rules->has_voltage)
        rules->voltage_v = voltage_v;
    rules->has_voltage = true;
    rules->voltage_v += (voltage_v - rules->voltage_v) * (1.0f - expf(-elapsed_s / BATTERY_FILTER_S));
    uint8_t below = 0, not_clear = 0;
    for (uint8_t i = 0; i < THRESHOLDS; i++) {
        below = (uint8_t)(below + (rules->voltage_v < threshold_v[i]));
        not_clear = (uint8_t)(not_clear + (rules->voltage_v < threshold_v[i] + hysteresis_v));
    }
    const uint8_t was = rules->charge, at_least = was > below ? was : below;
    rules->charge = at_least < not_clear ? at_least : not_clear;
    if (rules->charge == was)
        return;
    const bool empty = rules->charge == CHARGE_NEUTRAL;
    say_charge(rules, empty ? SAY_CRITICAL : rules->charge > was ? SAY_WARNING : SAY_INFO, voltage_v);
    if (empty && rules->armed)
        disarm(rules, SAY_CRITICAL, PSTR("disarmed: battery empty"));
}

/* --- time goes on */

/* Move towards the command, thrusters no faster than the slew rate. */
static void move(struct rules *rules, float reach_us) {
    for (uint8_t i = 0; i < CHANNELS; i++) {
        const float way_us = rules->command_us[i] - rules->echo_us[i];
        if (i < rules->thrusters)
            rules->echo_us[i] += fminf(fmaxf(way_us, -reach_us), reach_us);
        else if (rules->command_us[i] != IGNORED)
            rules->echo_us[i] = rules->command_us[i];
    }
}

void rules_step(struct rules *rules, uint64_t now_us) {
    const float *value = rules->parameters.value;
    if (rules->armed && is_stale(rules, now_us)) {
        disarm(rules, SAY_WARNING, PSTR("disarmed: no override for "));
        struct text *text = &rules->text[rules->texts - 1];
        text_number(text, (uint32_t)value[CMD_AGE_MS]);
        text_flash(text, PSTR(" ms"));
    }
    const bool later = rules->has_stepped && now_us > rules->stepped_at_us;
    const float elapsed_s = later ? (float)(now_us - rules->stepped_at_us) * 1e-6f : 0.0f;
    rules->has_stepped = true;
    rules->stepped_at_us = now_us;
    if (rules->armed) {
        move(rules, value[SLEW_US_S] * elapsed_s);
        return;
    }
    for (uint8_t i = 0; i < rules->thrusters; i++)
        rules->echo_us[i] = value[THR_NEUTRAL_US];
}
