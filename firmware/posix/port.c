/* The firmware as a program, dry and at rest, for tests, sanitizers and clients of MAVLink.

    board ROBOT pty:PATH|udp:HOST:PORT MEMORY

MEMORY is the file that stands for the EEPROM; it is made if it is not there. */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "../board_hal.h"
#include "../loop.h"

enum { UDP_PEERS = 8, DATAGRAM_BYTES = 2048 };
#define PEER_GONE_US 10000000u
#define REST_V 12.3f

struct udp_peer {
    struct sockaddr_in address;
    uint64_t heard_us;
};

static int link_fd = -1, memory_fd = -1, terminal_fd = -1;
static bool is_udp;
static struct udp_peer peers[UDP_PEERS];
static uint8_t peer_count;
static struct sockaddr_in sender; /* of the datagram that was read last */
static uint8_t datagram[DATAGRAM_BYTES];
static uint16_t datagram_bytes, datagram_read;
static uint8_t eeprom[HAL_EEPROM_BYTES];
static const char *terminal_path;
static volatile sig_atomic_t is_stopped;

/* --- time */

static uint64_t monotonic_us(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

static uint64_t power_on_us;

struct start hal_start(void) { return (struct start){.causes = RESET_POWER_ON, .is_power_on = true}; }

uint64_t hal_now_us(void) { return monotonic_us() - power_on_us; }

void hal_alive(void) {}

void hal_idle(uint64_t until_us) {
    const uint64_t now_us = hal_now_us();
    struct pollfd link = {.fd = link_fd, .events = POLLIN};
    const struct timespec wait = {0, until_us > now_us ? (long)(until_us - now_us) * 1000 : 0};
    ppoll(&link, 1, &wait, NULL);
}

/* --- link */

static uint16_t read_datagram(uint8_t *data, uint16_t room) {
    if (datagram_read == datagram_bytes) {
        socklen_t size = sizeof sender;
        const ssize_t got = recvfrom(link_fd, datagram, sizeof datagram, 0, (struct sockaddr *)&sender, &size);
        datagram_bytes = got > 0 ? (uint16_t)got : 0;
        datagram_read = 0;
    }
    const uint16_t left = (uint16_t)(datagram_bytes - datagram_read), bytes = left < room ? left : room;
    memcpy(data, datagram + datagram_read, bytes);
    datagram_read = (uint16_t)(datagram_read + bytes);
    return bytes;
}

uint16_t hal_read(uint8_t *data, uint16_t room) {
    if (is_udp)
        return read_datagram(data, room);
    const ssize_t got = read(link_fd, data, room);
    return got > 0 ? (uint16_t)got : 0;
}

static bool same_address(const struct sockaddr_in *a, const struct sockaddr_in *b) {
    return a->sin_addr.s_addr == b->sin_addr.s_addr && a->sin_port == b->sin_port;
}

void hal_heard(void) {
    uint8_t at = 0, oldest = 0;
    while (at < peer_count && !same_address(&peers[at].address, &sender)) {
        oldest = peers[at].heard_us < peers[oldest].heard_us ? at : oldest;
        at++;
    }
    if (at == UDP_PEERS)
        at = oldest;
    else if (at == peer_count)
        peer_count++;
    peers[at] = (struct udp_peer){sender, hal_now_us()};
}

static void send_to_peers(const uint8_t *data, uint16_t bytes) {
    const uint64_t now_us = hal_now_us();
    for (uint8_t i = 0; i < peer_count;) {
        if (now_us - peers[i].heard_us > PEER_GONE_US && peer_count > 1) {
            peers[i] = peers[--peer_count];
            continue;
        }
        sendto(link_fd, data, bytes, 0, (const struct sockaddr *)&peers[i].address, sizeof peers[i].address);
        i++;
    }
}

uint16_t hal_waiting(void) { return 0; } /* the kernel does not say since when: read at once */

uint16_t hal_write(const uint8_t *data, uint16_t bytes) {
    if (is_udp)
        send_to_peers(data, bytes);
    else if (write(link_fd, data, bytes) < 0 && errno != EAGAIN)
        is_stopped = 1;
    return bytes; /* what nobody reads is lost, as on a wire */
}

/* --- outputs, sensors, memory */

void hal_outputs(const uint16_t pulses_us[CHANNELS]) { (void)pulses_us; }

float hal_battery_v(void) { return REST_V; }

void hal_sample(uint64_t now_us, float gyro_bias_radps, struct reading *reading) {
    (void)now_us;
    (void)gyro_bias_radps;
    *reading = (struct reading){.acceleration_mps2 = {0.0f, 0.0f, -9.81f}, .temperature_cdegc = 2000};
}

uint8_t hal_eeprom_read(uint16_t address) { return eeprom[address]; }

bool hal_eeprom_busy(void) { return false; }

void hal_eeprom_write(uint16_t address, uint8_t value) {
    eeprom[address] = value;
    if (pwrite(memory_fd, &value, 1, address) != 1)
        is_stopped = 1;
}

/* --- program */

static void stop(int signal_number) {
    (void)signal_number;
    is_stopped = 1;
}

static void fail(const char *what) {
    fprintf(stderr, "%s: %s\n", what, strerror(errno));
    exit(1);
}

static void open_memory(const char *path) {
    memset(eeprom, 0xFF, sizeof eeprom);
    memory_fd = open(path, O_RDWR | O_CREAT, 0600);
    if (memory_fd < 0)
        fail(path);
    const ssize_t got = pread(memory_fd, eeprom, sizeof eeprom, 0);
    if (got < 0 || pwrite(memory_fd, eeprom, sizeof eeprom, 0) != (ssize_t)sizeof eeprom)
        fail(path);
}

static void open_terminal(const char *path) {
    link_fd = posix_openpt(O_RDWR | O_NOCTTY);
    const char *name = link_fd >= 0 && grantpt(link_fd) == 0 && unlockpt(link_fd) == 0 ? ptsname(link_fd) : NULL;
    terminal_fd = name != NULL ? open(name, O_RDWR | O_NOCTTY) : -1; /* held open: a computer may come and go */
    struct termios raw;
    if (terminal_fd < 0 || tcgetattr(terminal_fd, &raw) != 0)
        fail(path);
    cfmakeraw(&raw);
    if (tcsetattr(terminal_fd, TCSANOW, &raw) != 0 || symlink(name, path) != 0)
        fail(path);
    terminal_path = path;
    fcntl(link_fd, F_SETFL, O_NONBLOCK);
}

static void open_udp(char *address) {
    char *port = strrchr(address, ':');
    struct sockaddr_in here = {.sin_family = AF_INET};
    if (port == NULL) {
        errno = EINVAL;
        fail(address);
    }
    *port++ = '\0';
    here.sin_port = htons((uint16_t)strtoul(port, NULL, 10));
    link_fd = socket(AF_INET, SOCK_DGRAM | SOCK_NONBLOCK, 0);
    if (inet_pton(AF_INET, address, &here.sin_addr) != 1 || bind(link_fd, (struct sockaddr *)&here, sizeof here) != 0)
        fail(address);
    is_udp = true;
}

int main(int arguments, char **argument) {
    const long robot = arguments == 4 ? strtol(argument[1], NULL, 10) : 0;
    const bool pty = robot > 0 && strncmp(argument[2], "pty:", 4) == 0, udp = robot > 0 && strncmp(argument[2], "udp:", 4) == 0;
    if (robot < 1 || robot > 255 || !(pty || udp)) {
        fprintf(stderr, "usage: %s ROBOT(1 to 255) pty:PATH|udp:ADDRESS:PORT MEMORY\n", argument[0]);
        return 2;
    }
    const struct sigaction stopping = {.sa_handler = stop};
    sigaction(SIGTERM, &stopping, NULL);
    sigaction(SIGINT, &stopping, NULL);
    open_memory(argument[3]);
    if (pty)
        open_terminal(argument[2] + 4);
    else
        open_udp(argument[2] + 4);
    power_on_us = monotonic_us();
    static struct loop loop;
    loop_begin(&loop, (uint8_t)robot);
    while (!is_stopped)
        loop_once(&loop);
    if (terminal_path != NULL)
        unlink(terminal_path);
    return 0;
}
