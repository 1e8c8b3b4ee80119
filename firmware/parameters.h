/* The parameters of the board: their table, bounds and relations. The counterpart of sim_bridge/thruster_board/parameters.py,
from which generate.py writes the table. */
#ifndef PARAMETERS_H
#define PARAMETERS_H

#include <stdbool.h>
#include <stdint.h>

enum parameter {
#define PARAMETER(name, low, high, whole, standard, bounds) name,
#include "parameter_table.h"
#undef PARAMETER
    PARAMETERS,
    NO_PARAMETER = -1
};

enum { PARAMETER_NAME = 16, CURVE_POINTS = (PARAMETERS - CRV01_US) / 2, THRESHOLDS = 3 };

struct parameter_row {
    char name[PARAMETER_NAME + 1], bounds[21];
    float low, high, standard;
    bool whole;
};

struct parameters {
    float value[PARAMETERS];
};

enum refusal { TAKEN, UNKNOWN_PARAMETER, OUT_OF_RANGE, NOT_REAL32, INCONSISTENT, REFUSED_ARMED };

void parameters_standard(struct parameters *parameters); /* those of the experiment that the firmware was built for */
struct parameter_row parameter_row(int index);
int parameter_named(const char name[PARAMETER_NAME]); /* ends at a zero or after 16 characters; NO_PARAMETER if unknown */
enum refusal parameters_change(struct parameters *parameters, int index, float value);
bool parameters_are_valid(const struct parameters *parameters); /* each in range, and fitting one another */
bool is_neutral_pulse(const struct parameters *parameters, uint16_t pulse_us); /* in the dead zone of the thrust curve */

#endif
