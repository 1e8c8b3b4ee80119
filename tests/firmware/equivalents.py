"""Changes of the C code that no test can notice, each with the reason. tests/firmware/mutants.py leaves them out of its list.

A change is a file, a line as it stands, the line as it becomes, without the blanks around either, and the reason.

Of the rules in Python `mutmut` leaves seven changes that no test can notice, either:

* state_machine.py, the first value of `_command`: nothing reads it before an override.
* state_machine.py, `* BATTERY_FILTER_S` for `/`: it is 1 s; `self.charge >= was`: they differ there.
* parameters.py, `strict` of `zip` in `_curve_points`, three changes: there are as many thrusts as pulses.
* parameters.py, the upper end of no dead zone: nothing lies above its lower end, which is infinite.
"""

EQUIVALENTS = [
    (
        "parameters.c", "bool reached = false, left = true;", "bool reached = false, left = false;",
        "`left` counts only where a point of the curve was reached, and is set there",
    ),
    (
        "rules.c", "memmove(rules->text, rules->text + 1, sizeof rules->text - sizeof rules->text[0]);",
        "memmove(rules->text, rules->text + 1, sizeof rules->text - sizeof rules->text[1]);",
        "all texts have one size",
    ),
    ("rules.c", "if (trimmed_us < pin->lowest_us)", "if (trimmed_us <= pin->lowest_us)", "the greater of two equal ones"),
    (
        "rules.c", "return trimmed_us < pin->highest_us ? trimmed_us : pin->highest_us;",
        "return trimmed_us <= pin->highest_us ? trimmed_us : pin->highest_us;", "the smaller of two equal ones",
    ),
    (
        "rules.c", "return !rules->has_command || (now_us > rules->command_at_us && now_us - rules->command_at_us > age_us);",
        "return !rules->has_command || (now_us >= rules->command_at_us && now_us - rules->command_at_us > age_us);",
        "no time has passed then, which is no longer than any age",
    ),
    (
        "rules.c", "rules->voltage_v += (voltage_v - rules->voltage_v) * (1.0f - expf(-elapsed_s / BATTERY_FILTER_S));",
        "rules->voltage_v += (voltage_v - rules->voltage_v) * (1.0f - expf(-elapsed_s * BATTERY_FILTER_S));",
        "the time constant is 1 s",
    ),
    (
        "rules.c", "const uint8_t was = rules->charge, at_least = was > below ? was : below;",
        "const uint8_t was = rules->charge, at_least = was >= below ? was : below;", "the greater of two equal ones",
    ),
    (
        "rules.c", "rules->charge = at_least < not_clear ? at_least : not_clear;",
        "rules->charge = at_least <= not_clear ? at_least : not_clear;", "the smaller of two equal ones",
    ),
    (
        "rules.c", "say_charge(rules, empty ? SAY_CRITICAL : rules->charge > was ? SAY_WARNING : SAY_INFO, voltage_v);",
        "say_charge(rules, empty ? SAY_CRITICAL : rules->charge >= was ? SAY_WARNING : SAY_INFO, voltage_v);",
        "they differ there",
    ),
    (
        "rules.c", "const bool later = rules->has_stepped && now_us > rules->stepped_at_us;",
        "const bool later = rules->has_stepped && now_us >= rules->stepped_at_us;", "no time has passed then, either way",
    ),
    (
        "signing.c",
        "const uint16_t left = at < job->length ? (uint16_t)(job->length - at) : 0, bytes = left < room ? left : room;",
        "const uint16_t left = at <= job->length ? (uint16_t)(job->length - at) : 0, bytes = left < room ? left : room;",
        "the difference of two equal ones is 0",
    ),
    (
        "signing.c",
        "const uint16_t left = at < job->length ? (uint16_t)(job->length - at) : 0, bytes = left < room ? left : room;",
        "const uint16_t left = at < job->length ? (uint16_t)(job->length - at) : 0, bytes = left <= room ? left : room;",
        "the smaller of two equal ones",
    ),
    ("signing.c", "if (bytes > 0)", "if (bytes >= 0)", "to copy no bytes does nothing"),
    ("signing.c", "if (timestamp > gate->newest)", "if (timestamp >= gate->newest)", "sets it to what it is"),
    (
        "signing.c", "for (uint8_t i = 0; i < 6; i++, timestamp >>= 8)", "for (uint8_t i = 0; i <= 6; i++, timestamp >>= 8)",
        "both callers write the byte behind a timestamp afterwards: a hash, a stamp or a checksum",
    ),
    ("store.c", "const uint16_t counted = read16(store->record + COUNT_AT);",
     "const uint16_t counted = read16(store->record - COUNT_AT);", "COUNT_AT is 0"),
    (
        "store.c", "if (!found || (int16_t)(counted - store->count[area]) > 0) {",
        "if (!found || (int16_t)(counted - store->count[area]) >= 0) {", "no two records of an area have one count",
    ),
    (
        "store.c",
        "while (at < SETTINGS_SLOT && hal_eeprom_read((uint16_t)((uint16_t)(slot * SETTINGS_SLOT) + at)) == 0xFF)",
        "while (at <= SETTINGS_SLOT && hal_eeprom_read((uint16_t)((uint16_t)(slot * SETTINGS_SLOT) + at)) == 0xFF)",
        "a place of which all bytes were read counts as not written, whatever comes behind it",
    ),
    (
        "store.c", "parameters_standard(&memory->settings.parameters);", ";",
        "parameters that are all 0 are not valid: the board takes those of the build",
    ),
    ("store.c", "write16(record + COUNT_AT, ++store->count[area]);",
     "write16(record - COUNT_AT, ++store->count[area]);", "COUNT_AT is 0"),
    ("store.c", "memset(store->record, 0, ZEROS_SLOT);", "memset(store->record, 1, ZEROS_SLOT);", "bytes that nobody reads"),
    ("store.c", "memset(store->record, 0, ZEROS_SLOT);", ";", "bytes that nobody reads"),
    ("store.c", "memset(store->record, 0, sizeof store->record);", "memset(store->record, 1, sizeof store->record);",
     "bytes that nobody reads"),
    ("store.c", "memset(store->record, 0, sizeof store->record);", ";", "bytes that nobody reads"),
]  # fmt: skip
