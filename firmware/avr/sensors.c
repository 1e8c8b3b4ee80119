/* IMU MPU-6050 (register map RM-MPU-6000A), pressure sensor MS5837-30BA (data sheet ENG_DS_MS5837-30BA), battery at A0.

A sensor that does not answer is NaN on the link, which the robot's computer takes for no measurement. */
#include <avr/io.h>
#include <math.h>

#include "avr.h"

enum { MPU = 0x68, MPU_POWER = 0x6B, MPU_FILTER = 0x1A, MPU_GYRO_RANGE = 0x1B, MPU_FORCE_RANGE = 0x1C, MPU_DATA = 0x3B,
       MPU_WHO = 0x75, MPU_IS = 0x68 };
enum { MS = 0x76, MS_RESET = 0x1E, MS_PRESSURE = 0x48, MS_TEMPERATURE = 0x58, MS_RESULT = 0x00, MS_PROM = 0xA0 };
enum { ADC_CONVERT = 1 << ADEN | 1 << ADSC | 1 << ADPS2 | 1 << ADPS1 | 1 << ADPS0 }; /* 125 kHz: 104 us */
enum { PROM_WORDS = 7, TEMPERATURE_EVERY = 25, RETRY_SAMPLES = 50, SAME_SAMPLES = 25, LOOK_SAMPLES = 50, MPU_ASLEEP = 1 << 6 };
#define FORCE_UNIT_MPS2 (9.80665f / 8192.0f)          /* +-4 g */
#define GYRO_UNIT_RADPS (0.017453293f / 65.5f)        /* +-500 degrees/s */
#define BATTERY_UNIT_V (5.0f / 1024.0f * BATTERY_DIVIDER)
#define HPA_PER_UNIT 0.1f
#define STANDARD_HPA 1013.25f
enum { LEAST_HPA = 300, MOST_HPA = 31000, LEAST_CDEGC = -2000, MOST_CDEGC = 8500 }; /* what the MS5837 can measure */

/* What both chips have. One that is not live is begun anew: at once if it answers, otherwise once a second. It is live with the first
value that is another one than that before: noise moves the last bits of a chip that measures. */
struct chip {
    uint8_t state;    /* enum chip_state */
    uint8_t wait;     /* samples until the next look at a chip that is not live */
    uint8_t same;     /* samples in a row with the same value */
    uint16_t value;   /* checksum of the last one */
};

static struct chip imu = {CHIP_ABSENT, 0, 0, 0}, pressure = {CHIP_ABSENT, 0, 0, 0};
static float heading_rad;
static uint64_t sampled_at_us;
static uint8_t until_look, until_temperature;
static uint16_t prom[PROM_WORDS];
static uint8_t prom_words; /* that are read: one with each sample */
static bool has_temperature, has_value;
static uint32_t raw_temperature;
static uint8_t converting; /* the command of the conversion that goes on */

/* Not live from now on, and to be begun anew: one that was live after so many samples, another one once a second. Returns false:
nothing is measured. */
static bool lose(struct chip *chip, uint8_t state, uint8_t wait) {
    chip->wait = chip->state == CHIP_LIVE ? wait : RETRY_SAMPLES;
    chip->state = state;
    return false;
}

/* True if a chip that answers is live: its value changes. */
static bool is_live(struct chip *chip, const uint8_t *data, uint8_t bytes) {
    uint16_t value = 0;
    while (bytes-- > 0)
        value = (uint16_t)((value << 5 | value >> 11) ^ data[bytes]);
    chip->same = value != chip->value ? 0 : chip->same < SAME_SAMPLES ? (uint8_t)(chip->same + 1) : SAME_SAMPLES;
    chip->value = value;
    if (chip->same == SAME_SAMPLES)
        return lose(chip, CHIP_STUCK, RETRY_SAMPLES);
    if (chip->same == 0)
        chip->state = CHIP_LIVE;
    return chip->state == CHIP_LIVE;
}

/* --- IMU */

static const uint8_t SETTINGS[][2] = {{MPU_POWER, 1}, {MPU_FILTER, 3}, {MPU_GYRO_RANGE, 1 << 3}, {MPU_FORCE_RANGE, 1 << 3}};
enum { MPU_SETTINGS = sizeof SETTINGS / sizeof SETTINGS[0] };

static bool imu_begin(void) {
    uint8_t who;
    if (!twi_read(MPU, MPU_WHO, &who, 1) || who != MPU_IS)
        return lose(&imu, CHIP_ABSENT, RETRY_SAMPLES);
    for (uint8_t i = 0; i < MPU_SETTINGS; i++)
        if (!twi_write(MPU, SETTINGS[i], 2))
            return lose(&imu, CHIP_ABSENT, RETRY_SAMPLES);
    imu.state = CHIP_STARTING;
    imu.same = 0;
    until_look = LOOK_SAMPLES;
    return false; /* it measures from the next sample on */
}

/* Look whether the chip is awake after each sample, in which its supply may have failed: it sleeps then. Look at all settings once a
second, or at zeros, which a chip without them shows. */
static bool imu_has_settings(bool zeros) {
    const bool looks_at_all = zeros || --until_look == 0;
    if (looks_at_all)
        until_look = LOOK_SAMPLES;
    for (uint8_t i = 0; i < (looks_at_all ? MPU_SETTINGS : 1); i++) {
        uint8_t set;
        if (!twi_read(MPU, SETTINGS[i][0], &set, 1))
            return lose(&imu, CHIP_ABSENT, 1);
        if (set != SETTINGS[i][1])
            return lose(&imu, i == 0 && set & MPU_ASLEEP ? CHIP_ASLEEP : CHIP_RESET, 1);
    }
    return true;
}

/* The board's axes are x ahead, y to starboard, z down; the chip is mounted with x ahead, y to port, z up. */
static bool imu_sample(float elapsed_s, float gyro_bias_radps, struct reading *reading) {
    uint8_t data[14];
    if (imu.wait > 0 && --imu.wait > 0)
        return false;
    if (imu.state != CHIP_LIVE && imu.state != CHIP_STARTING)
        return imu_begin();
    if (!twi_read(MPU, MPU_DATA, data, sizeof data))
        return lose(&imu, CHIP_ABSENT, 1);
    int16_t word[7];
    for (uint8_t i = 0; i < 7; i++)
        word[i] = (int16_t)((uint16_t)data[2 * i] << 8 | data[2 * i + 1]);
    const bool zeros = word[0] == 0 && word[1] == 0 && word[2] == 0;
    if (!imu_has_settings(zeros) || !is_live(&imu, data, sizeof data) || zeros)
        return false;
    reading->acceleration_mps2[0] = FORCE_UNIT_MPS2 * word[0];
    reading->acceleration_mps2[1] = -FORCE_UNIT_MPS2 * word[1];
    reading->acceleration_mps2[2] = -FORCE_UNIT_MPS2 * word[2];
    reading->yaw_rate_radps = -GYRO_UNIT_RADPS * word[6];
    heading_rad += (reading->yaw_rate_radps - gyro_bias_radps) * elapsed_s;
    if (fabsf(heading_rad) > (float)M_PI)
        heading_rad -= copysignf(2.0f * (float)M_PI, heading_rad);
    reading->heading_rad = heading_rad;
    return true;
}

/* --- pressure */

/* CRC-4 over the PROM, which holds it in its first four bits (application note AN520). */
static bool prom_is_whole(void) {
    uint16_t rest = 0;
    for (uint8_t i = 0; i < 16; i++) { /* the eighth word is 0 */
        const uint16_t word = i / 2 < PROM_WORDS ? (uint16_t)(i < 2 ? prom[0] & 0x0FFF : prom[i / 2]) : 0;
        rest ^= i % 2 ? word & 0xFF : word >> 8;
        for (uint8_t bit = 0; bit < 8; bit++)
            rest = (uint16_t)(rest & 0x8000 ? rest << 1 ^ 0x3000 : rest << 1);
    }
    return rest >> 12 == prom[0] >> 12;
}

static bool convert(uint8_t command) {
    converting = command;
    return twi_write(MS, &command, 1);
}

/* Begin with a reset, which loads the PROM: it is read from the next sample on. */
static bool pressure_begin(void) {
    const uint8_t reset = MS_RESET;
    prom_words = 0;
    converting = 0;
    has_temperature = has_value = false;
    if (!twi_write(MS, &reset, 1))
        return lose(&pressure, CHIP_ABSENT, RETRY_SAMPLES);
    pressure.state = CHIP_STARTING;
    pressure.same = 0;
    return false;
}

/* Read a word of the PROM; behind the last one begin to measure. */
static bool pressure_prepare(void) {
    uint8_t word[2];
    if (!twi_read(MS, (uint8_t)(MS_PROM + 2 * prom_words), word, 2))
        return lose(&pressure, CHIP_ABSENT, RETRY_SAMPLES);
    prom[prom_words++] = (uint16_t)(word[0] << 8 | word[1]);
    if (prom_words == PROM_WORDS && !(prom_is_whole() && convert(MS_TEMPERATURE)))
        return lose(&pressure, CHIP_ABSENT, RETRY_SAMPLES);
    return false;
}

/* First-order compensation, and the second-order one below 20 degrees, of the data sheet; 0.1 hPa and 0.01 degrees. */
static int32_t compensated(uint32_t raw_pressure, int16_t *temperature_cdegc) {
    const int32_t difference = (int32_t)raw_temperature - ((int32_t)prom[5] << 8);
    int32_t temperature = 2000 + (int32_t)((int64_t)difference * prom[6] >> 23);
    int64_t offset = ((int64_t)prom[2] << 16) + ((int64_t)prom[4] * difference >> 7);
    int64_t slope = ((int64_t)prom[1] << 15) + ((int64_t)prom[3] * difference >> 8);
    if (temperature < 2000) {
        const int64_t below = (int64_t)(temperature - 2000) * (temperature - 2000);
        offset -= 3 * below >> 1;
        slope -= 5 * below >> 3;
        temperature -= (int32_t)(3 * (int64_t)difference * difference >> 33);
    }
    *temperature_cdegc = (int16_t)temperature;
    return (int32_t)((((int64_t)raw_pressure * slope >> 21) - offset) >> 13);
}

/* Read what was converted since the last sample, and begin the next conversion (9 ms). 0 is what a chip answers that has not
converted: it lost its supply, or is late. */
static bool pressure_sample(struct reading *reading) {
    static int16_t temperature_cdegc;
    static float pressure_hpa;
    uint8_t data[3];
    if (pressure.wait > 0 && --pressure.wait > 0)
        return false;
    if (pressure.state != CHIP_LIVE && pressure.state != CHIP_STARTING)
        return pressure_begin();
    if (prom_words < PROM_WORDS)
        return pressure_prepare();
    if (!twi_read(MS, MS_RESULT, data, sizeof data))
        return lose(&pressure, CHIP_ABSENT, 1);
    const uint32_t raw = (uint32_t)data[0] << 16 | (uint32_t)data[1] << 8 | data[2];
    if (raw == 0)
        return lose(&pressure, CHIP_RESET, 1);
    if (converting == MS_TEMPERATURE) {
        raw_temperature = raw;
        has_temperature = true;
    } else if (has_temperature && is_live(&pressure, data, sizeof data)) {
        pressure_hpa = HPA_PER_UNIT * (float)compensated(raw, &temperature_cdegc);
        has_value = LEAST_HPA <= pressure_hpa && pressure_hpa <= MOST_HPA && LEAST_CDEGC <= temperature_cdegc &&
                    temperature_cdegc <= MOST_CDEGC;
        if (!has_value) /* no measurement of this chip: its coefficients or its supply are gone */
            return lose(&pressure, CHIP_RESET, RETRY_SAMPLES);
    }
    if (pressure.state == CHIP_STUCK)
        return false;
    until_temperature = until_temperature > 0 ? (uint8_t)(until_temperature - 1) : TEMPERATURE_EVERY;
    reading->excess_hpa = pressure_hpa - STANDARD_HPA;
    reading->temperature_cdegc = temperature_cdegc;
    if (!convert(until_temperature == 0 ? MS_TEMPERATURE : MS_PRESSURE))
        return lose(&pressure, CHIP_ABSENT, 1);
    return has_value;
}

void sensors_begin(void) {
    ADMUX = 1 << REFS0; /* AVcc */
    ADCSRB = 0;
    ADCSRA = ADC_CONVERT;
    twi_begin();
}

void sensors_sample(uint64_t now_us, float gyro_bias_radps, struct reading *reading) {
    const float elapsed_s = imu.state == CHIP_LIVE ? (float)(now_us - sampled_at_us) * 1e-6f : 0.0f;
    sampled_at_us = now_us;
    *reading = (struct reading){.heading_rad = NAN, .yaw_rate_radps = NAN, .acceleration_mps2 = {NAN, NAN, NAN}};
    imu_sample(elapsed_s, gyro_bias_radps, reading);
    if (!pressure_sample(reading))
        reading->excess_hpa = NAN;
    reading->chip[IMU] = imu.state;
    reading->chip[PRESSURE_SENSOR] = pressure.state;
}

/* Of the conversion that the last call began. */
float sensors_battery_v(void) {
    const float voltage_v = BATTERY_UNIT_V * (float)ADC;
    ADCSRA = ADC_CONVERT;
    return voltage_v;
}
