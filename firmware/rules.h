/* The rules of a thruster board as one pure state machine: docs/board.md. No clock, no link, no sensors: board.c has those.
The counterpart of sim_bridge/thruster_board/state_machine.py, in the same order.

For any order of calls, the thrusters of a board that is stepped stand still unless it is armed and a valid override is young.
Times are microseconds of the board's own clock, since power-on. */
#ifndef RULES_H
#define RULES_H

#include <stdbool.h>
#include <stdint.h>

#include "parameters.h"
#include "signing.h"
#include "text.h"

enum { CHANNELS = 8, IGNORED = 65535, TEXTS = 6 };
enum charge { CHARGE_GOOD, CHARGE_WARN, CHARGE_NO_ARM, CHARGE_NEUTRAL };
enum result { ACCEPTED = 0, REJECTED = 1, UNSUPPORTED = 3 }; /* MAV_RESULT; rejected: for now */

/* An output's parameters as whole numbers: each step asks for them, and an 8-bit processor has no others. */
struct pin {
    uint16_t lowest_us, highest_us;
    uint16_t rest_us; /* pulse without trim at power-on, and on the pin in HIL mode */
    int16_t trim_us;
};

struct rules {
    struct parameters parameters;
    struct peer computer; /* overrides count from here only */
    bool armed;
    uint8_t charge;
    bool has_command, has_voltage, has_stepped;
    uint16_t command_us[CHANNELS];
    uint64_t command_at_us, stepped_at_us;
    float voltage_v; /* filtered */
    float echo_us[CHANNELS]; /* pulses without trims: thrusters first, then ankles */
    struct pin pin[CHANNELS];
    uint8_t thrusters; /* of the outputs, from the first on */
    bool is_held;      /* the pins rest, whatever the outputs are */
    uint32_t overrides_refused;
    uint8_t texts;
    struct text text[TEXTS]; /* to send; the sender sets `texts` to 0 */
};

/* Power-on, with its parameters, which are valid. */
void rules_begin(struct rules *rules, struct peer computer);

/* What arrives. */
/* False if it was refused. */
bool rules_override(struct rules *rules, struct peer sender, const uint16_t pulses_us[CHANNELS], uint64_t now_us);
enum result rules_arm(struct rules *rules, bool wanted, uint64_t now_us);
enum refusal rules_change(struct rules *rules, int parameter, float value);
bool rules_take_key(struct rules *rules); /* false while armed; else the last override no longer counts */
void rules_battery(struct rules *rules, float voltage_v, float elapsed_s);

/* Time goes on: check the age of the last override and move the outputs. */
void rules_step(struct rules *rules, uint64_t now_us);

void rules_say(struct rules *rules, enum severity severity, const char *words); /* in flash memory */
bool rules_hil(const struct rules *rules);                            /* measurements are the simulator's */
uint16_t rules_echo_us(const struct rules *rules, uint8_t channel);   /* pulse without trim; in HIL mode what it would be */
uint16_t rules_output_us(const struct rules *rules, uint8_t channel); /* pulse on the pin, trim included */

#endif
