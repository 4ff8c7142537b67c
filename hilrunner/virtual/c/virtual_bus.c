/* The bench's side of virtual time: gives the turn to the nodes in a fixed order and carries frames between them and the bench.
 *
 * Events have a time and, at one time, an order: frames complete on the bus first, then nodes by their index; the bench's own tick at that
 * time has run before (vb_advance is called with the time of the next tick and stops short of it). A node that sleeps until the very moment
 * of a tick therefore sees what that tick has sent, and its answer reaches the tick after.
 *
 * A bus with a bit time carries one frame at a time. When it is free, the frame with the lowest identifier of all that wait begins
 * (ISO 11898-1, bitwise arbitration); it is received by everyone when it is complete. An ideal bus carries any number at once. */
#include "virtual_bus.h"

#include <errno.h>
#include <signal.h>
#include <stddef.h>
#include <string.h>
#include <sys/types.h>
#include <sys/wait.h>

#include "futex.h"

#define EFF_FLAG 0x80000000U
#define RTR_FLAG 0x40000000U
#define ID_MASK 0x1fffffffU
#define FLAG_BRS 0x01
#define QUEUE_SIZE 4096      /* frames that wait for one bus, of all who send on it */
#define BENCH_SIZE 16384     /* frames received by the bench and not yet taken */
#define LOOK_NS 20000000LL   /* wall-clock time between two looks at a node that keeps the turn: is its process alive? */

typedef struct {
    vb_frame_t waiting[QUEUE_SIZE];
    int64_t order[QUEUE_SIZE]; /* the sequence in which they came: equal identifiers keep it */
    int count;
    int64_t free_mono_ns; /* the bus is busy until then; the frame under way is `moving` */
    vb_frame_t moving;
    int is_moving;
    uint64_t carried, refused;
    int64_t busy_ns;
} bus_t;

typedef struct {
    vb_region_t *region;
    int64_t wall_limit_ns; /* a node may compute this long, of wall-clock time, before it counts as hung */
    int spins;
    int64_t sequence;
    bus_t bus[VB_BUSES_MAX];
    vb_frame_t inbox[BENCH_SIZE];
    uint64_t inbox_written, inbox_read, inbox_dropped;
    int64_t turns;
    int failed_node;
    int failure; /* enum vb_failure */
} hub_t;

enum vb_failure { VB_FINE = 0, VB_HUNG = 1, VB_ENDED = 2, VB_REFUSED = 3 };

size_t vb_hub_size(void) { return sizeof(hub_t); }
size_t vb_region_size(void) { return sizeof(vb_region_t); }
size_t vb_node_offset(int node) { return offsetof(vb_region_t, node) + (size_t)node * sizeof(vb_node_t); }

void vb_hub_init(hub_t *hub, vb_region_t *region, int64_t wall_limit_ns, int spins)
{
    memset(hub, 0, sizeof *hub);
    hub->region = region;
    hub->wall_limit_ns = wall_limit_ns;
    hub->spins = spins;
    hub->failed_node = -1;
    region->size_bytes = sizeof *region;
    __atomic_store_n(&region->magic, VB_MAGIC, __ATOMIC_RELEASE);
}

int vb_failure(const hub_t *hub) { return hub->failure; }
int vb_failed_node(const hub_t *hub) { return hub->failed_node; }
int64_t vb_turns(const hub_t *hub) { return hub->turns; }
uint64_t vb_inbox_dropped(const hub_t *hub) { return hub->inbox_dropped; }
uint64_t vb_bus_carried(const hub_t *hub, int bus) { return hub->bus[bus].carried; }
int64_t vb_bus_busy_ns(const hub_t *hub, int bus) { return hub->bus[bus].busy_ns; }
uint64_t vb_bus_refused(const hub_t *hub, int bus) { return hub->bus[bus].refused; }

void vb_set_bus(vb_region_t *region, int bus, const char *name, int fd, int64_t nominal_bit_ps, int64_t data_bit_ps)
{
    vb_bus_t *one = &region->bus[bus];
    strncpy(one->name, name, VB_NAME_SIZE - 1);
    one->fd = fd;
    one->nominal_bit_ps = nominal_bit_ps;
    one->data_bit_ps = data_bit_ps;
    if (bus >= region->bus_count) {
        region->bus_count = bus + 1;
    }
}

void vb_set_clock(vb_region_t *region, int64_t now_mono_ns, int64_t real_minus_mono_ns, int node_count)
{
    region->now_mono_ns = now_mono_ns;
    region->real_minus_mono_ns = real_minus_mono_ns;
    region->node_count = node_count;
    for (int node = 0; node < node_count; node++) {
        region->node[node].turn = VB_TURN_BENCH;
        region->node[node].state = VB_STATE_EMPTY;
        region->node[node].wake_mono_ns = now_mono_ns; /* it runs first */
    }
}

void vb_set_starter(vb_region_t *region, int node, int32_t pid) { region->node[node].starter = pid; }
int vb_node_state(const vb_region_t *region, int node) { return __atomic_load_n(&region->node[node].state, __ATOMIC_ACQUIRE); }
int vb_node_loaded(const vb_region_t *region, int node) { return __atomic_load_n(&region->node[node].loaded, __ATOMIC_ACQUIRE); }
const char *vb_node_text(const vb_region_t *region, int node) { return region->node[node].text; }
uint64_t vb_node_dropped(const vb_region_t *region, int node) { return region->node[node].receive_dropped; }
uint64_t vb_node_refused(const vb_region_t *region, int node) { return region->node[node].send_refused; }

/* Bits of a frame on the wire, without stuff bits' chance: the worst case of stuffing (ISO 11898-1; Davis et al. 2007 for classic CAN). */
static void frame_bits(const vb_frame_t *frame, int64_t *nominal, int64_t *data)
{
    uint32_t id;
    memcpy(&id, frame->frame, sizeof id);
    int length = frame->frame[4];
    int extended = (id & EFF_FLAG) != 0;
    if (frame->size != VB_FRAME_SIZE) {
        int stuffed = (extended ? 54 : 34) + ((id & RTR_FLAG) ? 0 : 8 * length);
        *nominal = stuffed + (stuffed - 1) / 4 + 13; /* 13: CRC delimiter, ACK, end of frame, intermission: never stuffed */
        *data = 0;
        return;
    }
    int arbitration = extended ? 35 : 17;
    int crc = length > 16 ? 21 : 17;
    int payload = 8 + 8 * length; /* ESI and DLC with it */
    int fixed_stuff = 5 + crc / 4;
    *nominal = arbitration + arbitration / 4 + 13;
    *data = payload + payload / 4 + 4 + crc + fixed_stuff;
}

static int64_t frame_length_ns(const vb_bus_t *bus, const vb_frame_t *frame)
{
    int64_t nominal, data;
    frame_bits(frame, &nominal, &data);
    int64_t data_bit_ps = bus->data_bit_ps != 0 && (frame->frame[5] & FLAG_BRS) ? bus->data_bit_ps : bus->nominal_bit_ps;
    return (nominal * bus->nominal_bit_ps + data * data_bit_ps + 500) / 1000;
}

/* Lower wins: the identifier bit by bit as it stands on the wire; a base frame beats an extended one with the same first eleven bits. */
static uint64_t priority(const vb_frame_t *frame)
{
    uint32_t id;
    memcpy(&id, frame->frame, sizeof id);
    uint64_t bits = id & ID_MASK;
    uint64_t remote = (id & RTR_FLAG) != 0;
    if (id & EFF_FLAG) {
        return (bits >> 18) << 21 | 1ULL << 20 | (bits & 0x3ffff) << 1 | remote;
    }
    return bits << 21 | (uint64_t)remote << 19;
}

static void to_node(vb_region_t *region, int index, const vb_frame_t *frame, int64_t now_mono_ns, int own)
{
    vb_node_t *node = &region->node[index];
    if (!(node->buses >> frame->bus & 1)) {
        return;
    }
    if (node->receive_written - node->receive_read >= VB_RECEIVE_SIZE) {
        node->receive_dropped++;
        return;
    }
    vb_frame_t *slot = &node->receive[node->receive_written % VB_RECEIVE_SIZE];
    *slot = *frame;
    slot->stamp_mono_ns = now_mono_ns;
    slot->own = own;
    node->receive_written++;
    if (node->wake_on_frame && node->wake_mono_ns > now_mono_ns) {
        node->wake_mono_ns = now_mono_ns;
    }
}

/* Everyone on the bus has the frame, now. */
static void deliver(hub_t *hub, const vb_frame_t *frame, int64_t now_mono_ns)
{
    vb_region_t *region = hub->region;
    hub->bus[frame->bus].carried++;
    for (int node = 0; node < region->node_count; node++) {
        to_node(region, node, frame, now_mono_ns, node == frame->source);
    }
    if (frame->source == VB_BENCH || frame->bus != 0) {
        return; /* the bench sits on the first bus */
    }
    if (hub->inbox_written - hub->inbox_read >= BENCH_SIZE) {
        hub->inbox_dropped++;
        return;
    }
    vb_frame_t *slot = &hub->inbox[hub->inbox_written % BENCH_SIZE];
    *slot = *frame;
    slot->stamp_mono_ns = now_mono_ns;
    hub->inbox_written++;
}

static void begin_next(hub_t *hub, int index, int64_t now_mono_ns)
{
    bus_t *bus = &hub->bus[index];
    if (bus->is_moving || bus->count == 0) {
        return;
    }
    int first = 0;
    for (int k = 1; k < bus->count; k++) {
        uint64_t a = priority(&bus->waiting[k]), b = priority(&bus->waiting[first]);
        if (a < b || (a == b && bus->order[k] < bus->order[first])) {
            first = k;
        }
    }
    bus->moving = bus->waiting[first];
    bus->is_moving = 1;
    bus->count--;
    bus->waiting[first] = bus->waiting[bus->count];
    bus->order[first] = bus->order[bus->count];
    int64_t length_ns = frame_length_ns(&hub->region->bus[index], &bus->moving);
    bus->free_mono_ns = now_mono_ns + length_ns;
    bus->busy_ns += length_ns;
}

/* 0: the bus has taken the frame; -1: too many wait for it. */
static int offer(hub_t *hub, const vb_frame_t *frame, int64_t now_mono_ns)
{
    bus_t *bus = &hub->bus[frame->bus];
    if (hub->region->bus[frame->bus].nominal_bit_ps == 0) {
        deliver(hub, frame, now_mono_ns);
        return 0;
    }
    if (bus->count >= QUEUE_SIZE) {
        bus->refused++;
        return -1;
    }
    bus->waiting[bus->count] = *frame;
    bus->order[bus->count] = hub->sequence++;
    bus->count++;
    begin_next(hub, frame->bus, now_mono_ns);
    return 0;
}

static void collect(hub_t *hub, int index)
{
    vb_node_t *node = &hub->region->node[index];
    while (node->send_read < node->send_written) {
        vb_frame_t frame = node->send[node->send_read % VB_SEND_SIZE];
        frame.source = index;
        offer(hub, &frame, hub->region->now_mono_ns);
        node->send_read++;
    }
}

/* False when the process has ended; one that nobody has waited for yet has ended, too. */
static int is_alive(int32_t pid)
{
    siginfo_t ended = {0};
    if (pid == 0) {
        return 0;
    }
    if (waitid(P_PID, (id_t)pid, &ended, WEXITED | WNOHANG | WNOWAIT) == 0) {
        return ended.si_pid == 0;
    }
    return kill(pid, 0) == 0 || errno == EPERM; /* not our child: somebody else waits for it */
}

/* The node keeps the turn: true when nobody is left who could give it back. */
static int is_deserted(const vb_region_t *region, int index)
{
    const vb_node_t *node = &region->node[index];
    return vb_node_state(region, index) == VB_STATE_RUNNING ? !is_alive(node->pid) : !is_alive(node->starter);
}

/* Its process has ended. Where a script has started that process, the script goes on and may start the next one at this very moment. */
static void after_end(vb_region_t *region, vb_node_t *node)
{
    int goes_on = node->starter != node->pid && is_alive(node->starter);
    node->wake_mono_ns = goes_on ? region->now_mono_ns : VB_NEVER;
    node->wake_on_frame = 0;
    node->buses = 0;
}

/* Let the node run until it sleeps again. 0; a failure of enum vb_failure is noted. */
static int give_turn(hub_t *hub, int index)
{
    vb_node_t *node = &hub->region->node[index];
    int64_t waited_ns = 0;
    hub->turns++;
    node->turns++;
    vb_store_and_wake(&node->turn, VB_TURN_NODE);
    while (vb_wait_for(&node->turn, VB_TURN_BENCH, hub->spins, LOOK_NS) < 0) {
        waited_ns += LOOK_NS;
        if (is_deserted(hub->region, index)) {
            node->state = VB_STATE_ENDED;
            node->turn = VB_TURN_BENCH;
            break;
        }
        if (waited_ns >= hub->wall_limit_ns || hub->region->stop) {
            hub->failure = VB_HUNG;
            hub->failed_node = index;
            return -1;
        }
    }
    collect(hub, index);
    int state = vb_node_state(hub->region, index);
    if (state == VB_STATE_ENDED) {
        after_end(hub->region, node);
    } else if (state == VB_STATE_REFUSED) {
        hub->failure = VB_REFUSED;
        hub->failed_node = index;
        return -1;
    }
    return 0;
}

/* The node that runs next before `until_mono_ns`, or -1; times of bus events are looked at by the caller. */
static int next_node(const vb_region_t *region, int64_t *wake_mono_ns)
{
    int found = -1;
    for (int node = 0; node < region->node_count; node++) {
        if (region->node[node].wake_mono_ns < *wake_mono_ns) {
            *wake_mono_ns = region->node[node].wake_mono_ns;
            found = node;
        }
    }
    return found;
}

static int next_bus(const hub_t *hub, int64_t *time_mono_ns)
{
    int found = -1;
    for (int bus = 0; bus < hub->region->bus_count; bus++) {
        if (hub->bus[bus].is_moving && hub->bus[bus].free_mono_ns <= *time_mono_ns) {
            if (hub->bus[bus].free_mono_ns < *time_mono_ns || found < 0) {
                *time_mono_ns = hub->bus[bus].free_mono_ns;
                found = bus;
            }
        }
    }
    return found;
}

/* Let everything happen that happens before `until_mono_ns`, and set the clock to it. 0, or -1 when a node has failed. */
int64_t vb_advance(hub_t *hub, int64_t until_mono_ns)
{
    vb_region_t *region = hub->region;
    for (;;) {
        int64_t time_mono_ns = until_mono_ns;
        int node = next_node(region, &time_mono_ns);
        int64_t bus_mono_ns = node < 0 ? until_mono_ns : time_mono_ns; /* a frame complete at that moment comes first */
        int bus = next_bus(hub, &bus_mono_ns);
        if (bus >= 0) {
            if (bus_mono_ns > region->now_mono_ns) {
                region->now_mono_ns = bus_mono_ns;
            }
            hub->bus[bus].is_moving = 0;
            deliver(hub, &hub->bus[bus].moving, bus_mono_ns);
            begin_next(hub, bus, bus_mono_ns);
            continue;
        }
        if (node < 0) {
            break;
        }
        if (time_mono_ns > region->now_mono_ns) {
            region->now_mono_ns = time_mono_ns;
        }
        if (give_turn(hub, node) < 0) {
            return -1;
        }
    }
    region->now_mono_ns = until_mono_ns;
    return 0;
}

/* Frames the bench has received, oldest first: at most `room`. Rows of `frames` are struct canfd_frame. */
int64_t vb_receive(hub_t *hub, uint8_t *frames, int64_t *size_bytes, int64_t *real_ns, int64_t room)
{
    int64_t count = 0;
    while (count < room && hub->inbox_read < hub->inbox_written) {
        const vb_frame_t *frame = &hub->inbox[hub->inbox_read % BENCH_SIZE];
        memcpy(frames + count * VB_FRAME_SIZE, frame->frame, VB_FRAME_SIZE);
        size_bytes[count] = frame->size;
        real_ns[count] = frame->stamp_mono_ns + hub->region->real_minus_mono_ns;
        hub->inbox_read++;
        count++;
    }
    return count;
}

/* Send the bench's frames; how many the bus has taken. */
int64_t vb_send(hub_t *hub, const uint8_t *frames, const int64_t *size_bytes, int64_t count)
{
    for (int64_t k = 0; k < count; k++) {
        vb_frame_t frame = {.stamp_mono_ns = hub->region->now_mono_ns, .bus = 0, .source = VB_BENCH, .size = (int32_t)size_bytes[k]};
        memcpy(frame.frame, frames + k * VB_FRAME_SIZE, VB_FRAME_SIZE);
        if (offer(hub, &frame, hub->region->now_mono_ns) < 0) {
            return k;
        }
    }
    return count;
}

/* The run is over: whoever sleeps wakes, sees `stop` and ends as by SIGTERM. */
void vb_stop(hub_t *hub)
{
    __atomic_store_n(&hub->region->stop, 1, __ATOMIC_RELEASE);
    for (int node = 0; node < hub->region->node_count; node++) {
        vb_store_and_wake(&hub->region->node[node].turn, VB_TURN_NODE);
    }
}
