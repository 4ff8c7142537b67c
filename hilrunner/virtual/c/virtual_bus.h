/* The memory that the bench and the firmware processes share while time is virtual.
 *
 * The bench owns the clock. A node (one firmware process) runs only when it has the turn; it gives the turn back when it goes to sleep,
 * and says until when it sleeps and whether a frame wakes it. Nothing runs at the same time as anything else, so a run is a function of
 * its inputs alone. All times are CLOCK_MONOTONIC of the virtual clock, ns.
 *
 * hilrunner/virtual/region.py reads the sizes and offsets of these structs from the compiled library: they are named here only. */
#ifndef HILRUNNER_VIRTUAL_BUS_H
#define HILRUNNER_VIRTUAL_BUS_H

#include <stdint.h>

#define VB_MAGIC 0x68696c7662757331ULL /* "hilvbus1": a change of any struct below changes it */
#define VB_NODES_MAX 16
#define VB_BUSES_MAX 8
#define VB_NAME_SIZE 16
#define VB_TEXT_SIZE 240
#define VB_RECEIVE_SIZE 4096 /* frames on their way to a node; powers of two */
#define VB_SEND_SIZE 256     /* frames a node may send before time moves on; more find a full transmit queue (ENOBUFS) */
#define VB_NEVER INT64_MAX
#define VB_FRAME_SIZE 72 /* struct canfd_frame */
#define VB_BENCH (-1)

enum vb_turn { VB_TURN_BENCH = 0, VB_TURN_NODE = 1 };

enum vb_state {
    VB_STATE_EMPTY = 0,   /* no process has claimed this node yet */
    VB_STATE_RUNNING = 1, /* claimed */
    VB_STATE_ENDED = 2,   /* its process ended; a script that started it may start another, which claims the node again */
    VB_STATE_REFUSED = 3, /* it did what cannot be followed in virtual time; `text` says what */
};

typedef struct {
    int64_t stamp_mono_ns; /* send: when the node sent it; receive: when it was complete on the bus */
    int32_t bus;
    int32_t source; /* node that sent it, or VB_BENCH */
    int32_t size;   /* 16 or 72 */
    int32_t own;    /* 1: the receiver's own frame, complete on the bus */
    uint8_t frame[VB_FRAME_SIZE];
} vb_frame_t;

typedef struct {
    /* futex words, each written by one side at a time */
    int32_t turn;    /* enum vb_turn */
    int32_t state;   /* enum vb_state */
    int32_t pid;     /* of the process that claimed the node last */
    int32_t loaded;  /* processes that loaded the preloaded object for this node, ever */
    int32_t starter; /* the process that the bench has started for it: the firmware, or a script that runs it; 0: none */
    int32_t reserved;
    int64_t wake_mono_ns;  /* asleep until; VB_NEVER: until a frame comes */
    int32_t wake_on_frame; /* 1: a frame ends the sleep */
    int32_t buses;         /* bit k: it has an open socket on bus k */
    uint64_t send_written, send_read;
    uint64_t receive_written, receive_read;
    uint64_t receive_dropped; /* frames that found the receive ring full */
    uint64_t send_refused;    /* frames that found the send ring full */
    uint64_t turns;
    char text[VB_TEXT_SIZE];
    vb_frame_t send[VB_SEND_SIZE];
    vb_frame_t receive[VB_RECEIVE_SIZE];
} vb_node_t;

typedef struct {
    char name[VB_NAME_SIZE];
    int32_t fd;               /* 1: carries CAN FD */
    int32_t reserved;
    int64_t nominal_bit_ps;   /* length of a bit, ps; 0: ideal, a frame takes no time */
    int64_t data_bit_ps;      /* of the fast phase of an FD frame; 0: as nominal */
} vb_bus_t;

typedef struct {
    uint64_t magic;
    uint64_t size_bytes;
    int64_t now_mono_ns;
    int64_t real_minus_mono_ns; /* CLOCK_REALTIME of the virtual clock is now_mono_ns plus this */
    int32_t node_count;
    int32_t bus_count;
    int32_t stop; /* 1: the run is over; whoever waits ends as by SIGTERM */
    int32_t reserved;
    vb_bus_t bus[VB_BUSES_MAX];
    vb_node_t node[VB_NODES_MAX];
} vb_region_t;

#endif
