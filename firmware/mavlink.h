/* The generated MAVLink headers: layouts, lengths and checksum seeds of the dialect. Their parser and packer are not used. */
#ifndef BOARD_MAVLINK_H
#define BOARD_MAVLINK_H

#include <mavlink/common/mavlink.h>

#endif
