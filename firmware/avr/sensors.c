/* IMU MPU-6050 (register map RM-MPU-6000A), pressure sensor MS5837-30BA (data sheet ENG_DS_MS5837-30BA), battery at A0.

A sensor that does not answer is NaN on the link, which the robot's computer takes for no measurement. */
#include <avr/io.h>
#include <math.h>

#include "avr.h"

enum { MPU = 0x68, MPU_POWER = 0x6B, MPU_FILTER = 0x1A, MPU_GYRO_RANGE = 0x1B, MPU_FORCE_RANGE = 0x1C, MPU_DATA = 0x3B,
       MPU_WHO = 0x75, MPU_IS = 0x68 };
enum { MS = 0x76, MS_RESET = 0x1E, MS_PRESSURE = 0x48, MS_TEMPERATURE = 0x58, MS_RESULT = 0x00, MS_PROM = 0xA0 };
enum { ADC_CONVERT = 1 << ADEN | 1 << ADSC | 1 << ADPS2 | 1 << ADPS1 | 1 << ADPS0 }; /* 125 kHz: 104 us */
enum { PROM_WORDS = 7, STILL_SAMPLES = 50, SURFACE_SAMPLES = 10, TEMPERATURE_EVERY = 25, RETRY_SAMPLES = 50 };
#define FORCE_UNIT_MPS2 (9.80665f / 8192.0f)          /* +-4 g */
#define GYRO_UNIT_RADPS (0.017453293f / 65.5f)        /* +-500 degrees/s */
#define BATTERY_UNIT_V (5.0f / 1024.0f * BATTERY_DIVIDER)
#define HPA_PER_UNIT 0.1f

static bool has_imu, has_pressure;
static float heading_rad, gyro_bias_radps, surface_hpa;
static uint8_t still_samples, surface_samples, until_temperature;
static uint64_t sampled_at_us;
static uint16_t prom[PROM_WORDS];
static uint32_t raw_temperature;
static uint8_t converting; /* the command of the conversion that goes on */

static void imu_begin(void) {
    static const uint8_t settings[][2] = {{MPU_POWER, 1}, {MPU_FILTER, 3}, {MPU_GYRO_RANGE, 1 << 3}, {MPU_FORCE_RANGE, 1 << 3}};
    uint8_t who;
    has_imu = twi_read(MPU, MPU_WHO, &who, 1) && who == MPU_IS;
    for (uint8_t i = 0; i < sizeof settings / sizeof settings[0]; i++)
        has_imu = has_imu && twi_write(MPU, settings[i], 2);
}

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

static bool pressure_begin(void) {
    uint8_t word[2];
    for (uint8_t i = 0; i < PROM_WORDS; i++) {
        if (!twi_read(MS, (uint8_t)(MS_PROM + 2 * i), word, 2))
            return false;
        prom[i] = (uint16_t)(word[0] << 8 | word[1]);
    }
    return prom_is_whole();
}

static bool convert(uint8_t command) {
    converting = command;
    return twi_write(MS, &command, 1);
}

void sensors_begin(void) {
    ADMUX = 1 << REFS0; /* AVcc */
    ADCSRB = 0;
    ADCSRA = ADC_CONVERT;
    twi_begin();
    imu_begin();
    has_pressure = pressure_begin() && convert(MS_TEMPERATURE);
}

/* Begin anew, once a second, with a chip that was silent, or not what it should be. */
static void retry(void) {
    static uint8_t until_retry = RETRY_SAMPLES;
    if (--until_retry > 0)
        return;
    until_retry = RETRY_SAMPLES;
    if (!has_imu)
        imu_begin();
    if (!has_pressure)
        has_pressure = pressure_begin() && convert(MS_TEMPERATURE);
}

/* The board's axes are x ahead, y to starboard, z down; the chip is mounted with x ahead, y to port, z up. */
static bool imu_sample(float elapsed_s, struct reading *reading) {
    uint8_t data[14];
    if (!has_imu)
        return false;
    has_imu = twi_read(MPU, MPU_DATA, data, sizeof data);
    if (!has_imu)
        return false;
    int16_t word[7];
    for (uint8_t i = 0; i < 7; i++)
        word[i] = (int16_t)((uint16_t)data[2 * i] << 8 | data[2 * i + 1]);
    has_imu = word[0] != 0 || word[1] != 0 || word[2] != 0; /* no force at all: it lost its supply, and sleeps */
    if (!has_imu)
        return false;
    reading->acceleration_mps2[0] = FORCE_UNIT_MPS2 * word[0];
    reading->acceleration_mps2[1] = -FORCE_UNIT_MPS2 * word[1];
    reading->acceleration_mps2[2] = -FORCE_UNIT_MPS2 * word[2];
    const float rate_radps = -GYRO_UNIT_RADPS * word[6];
    if (still_samples < STILL_SAMPLES) { /* at rest after power-on: what the gyro shows is its bias */
        still_samples++;
        gyro_bias_radps += (rate_radps - gyro_bias_radps) / still_samples;
        reading->yaw_rate_radps = 0.0f;
    } else
        reading->yaw_rate_radps = rate_radps - gyro_bias_radps;
    heading_rad += reading->yaw_rate_radps * elapsed_s;
    if (fabsf(heading_rad) > (float)M_PI)
        heading_rad -= copysignf(2.0f * (float)M_PI, heading_rad);
    reading->heading_rad = heading_rad;
    return true;
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

/* Read what was converted since the last sample, and begin the next conversion (10 ms). */
static bool pressure_sample(struct reading *reading) {
    static int16_t temperature_cdegc = 2000;
    static float pressure_hpa;
    uint8_t data[3];
    if (!has_pressure || !twi_read(MS, MS_RESULT, data, sizeof data))
        return false;
    const uint32_t raw = (uint32_t)data[0] << 16 | (uint32_t)data[1] << 8 | data[2];
    if (converting == MS_TEMPERATURE)
        raw_temperature = raw;
    else
        pressure_hpa = HPA_PER_UNIT * (float)compensated(raw, &temperature_cdegc);
    if (converting == MS_PRESSURE && surface_samples < SURFACE_SAMPLES) { /* in air after power-on */
        surface_samples++;
        surface_hpa += (pressure_hpa - surface_hpa) / surface_samples;
    }
    until_temperature = until_temperature > 0 ? (uint8_t)(until_temperature - 1) : TEMPERATURE_EVERY;
    reading->excess_hpa = pressure_hpa - surface_hpa; /* 0 until the first pressure: the robot is in air */
    reading->temperature_cdegc = temperature_cdegc;
    return convert(until_temperature == 0 ? MS_TEMPERATURE : MS_PRESSURE);
}

void sensors_sample(uint64_t now_us, struct reading *reading) {
    const float elapsed_s = (float)(now_us - sampled_at_us) * 1e-6f;
    sampled_at_us = now_us;
    *reading = (struct reading){.heading_rad = NAN, .yaw_rate_radps = NAN, .acceleration_mps2 = {NAN, NAN, NAN}};
    retry();
    imu_sample(elapsed_s, reading);
    if (!pressure_sample(reading))
        reading->excess_hpa = NAN;
}

/* Of the conversion that the last call began. */
float sensors_battery_v(void) {
    const float voltage_v = BATTERY_UNIT_V * (float)ADC;
    ADCSRA = ADC_CONVERT;
    return voltage_v;
}
