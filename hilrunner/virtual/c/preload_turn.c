/* The region, and the turn: claimed at the first meeting with time, given back with every sleep, refused where it cannot be followed. */
#include "preload.h"

vb_region_t *region;
vb_node_t *node;
can_t *can_of[FD_MAX];
timer_t_ *timer_of[FD_MAX];
bool claimed;
static int node_index;
static pthread_t meeting_thread;
static pid_t claimed_pid;
static int free_calls;
static int64_t free_calls_at_ns;

void refuse(const char *what)
{
    if (node != NULL) {
        strncpy(node->text, what, VB_TEXT_SIZE - 1);
        __atomic_store_n(&node->state, VB_STATE_REFUSED, __ATOMIC_RELEASE);
        vb_store_and_wake(&node->turn, VB_TURN_BENCH);
    }
    fprintf(stderr, "hilrunner: virtual time cannot follow this program: %s\n", what);
    get__exit()(REFUSED_EXIT);
}

/* The run is over: as an operator ends it. The program may clean up, but time has ended: every sleep is an interrupted one from here on. */
static void end_by_stop(void)
{
    static int told;
    if (told++ == 0) {
        raise(SIGTERM);
    } else if (told > STOPPED_SLEEPS) {
        _exit(128 + SIGTERM);
    }
}

void give_back(void)
{
    if (claimed && claimed_pid == getpid()) {
        claimed = false;
        int32_t running = VB_STATE_RUNNING; /* a refusal stands */
        __atomic_compare_exchange_n(&node->state, &running, VB_STATE_ENDED, false, __ATOMIC_ACQ_REL, __ATOMIC_RELAXED);
        vb_store_and_wake(&node->turn, VB_TURN_BENCH);
    }
}

void _exit(int code) /* a program that stops dead: the bench need not wait to find out */
{
    give_back();
    get__exit()(code);
    __builtin_unreachable();
}

void _Exit(int code) { _exit(code); }

static void in_child(void)
{
    claimed = false; /* a child that only executes another program is fine; one that meets time claims, and is refused */
}

__attribute__((constructor)) static void load(void)
{
    const char *path = getenv("HILRUNNER_VIRTUAL_REGION");
    const char *index = getenv("HILRUNNER_VIRTUAL_NODE");
    if (path == NULL || index == NULL) {
        return;
    }
    int fd = open(path, O_RDWR | O_CLOEXEC);
    void *place = fd < 0 ? MAP_FAILED : mmap(NULL, sizeof(vb_region_t), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
    if (fd >= 0) {
        get_close()(fd);
    }
    if (place == MAP_FAILED || ((vb_region_t *)place)->magic != VB_MAGIC) {
        fprintf(stderr, "hilrunner: the region of virtual time at %s cannot be used: %s\n", path, strerror(errno));
        _exit(REFUSED_EXIT);
    }
    region = place;
    node_index = atoi(index);
    node = &region->node[node_index];
    __atomic_add_fetch(&node->loaded, 1, __ATOMIC_ACQ_REL);
    pthread_atfork(NULL, NULL, in_child);
    atexit(give_back);
}

__attribute__((destructor)) static void unload(void) { give_back(); }

/* This thread meets time: the node is ours from here on, or the program is refused. */
void claim(void)
{
    if (claimed) {
        if (!pthread_equal(meeting_thread, pthread_self())) {
            refuse("a second thread sleeps or uses CAN; one thread of a process may");
        }
        return;
    }
    int32_t state = __atomic_load_n(&node->state, __ATOMIC_ACQUIRE);
    if (state == VB_STATE_RUNNING && node->pid != getpid() && kill(node->pid, 0) == 0) {
        refuse("it has started a second process that sleeps or uses CAN; give each process a node of its own");
    }
    node->pid = getpid();
    claimed_pid = getpid();
    meeting_thread = pthread_self();
    claimed = true;
    /* the bench gives the first turn when it is at it */
    __atomic_store_n(&node->state, VB_STATE_RUNNING, __ATOMIC_RELEASE);
    while (vb_wait_for(&node->turn, VB_TURN_NODE, 0, FOREVER_NS) < 0) {
    }
    if (region->stop) {
        end_by_stop();
    }
}

int64_t now_ns(void) { return region->now_mono_ns; }

static bool passes(const can_t *can, uint32_t id)
{
    if (can->filter_count == 0) {
        return false;
    }
    bool all = true, any = false;
    for (int k = 0; k < can->filter_count; k++) {
        bool same = (id & can->filter[k].can_mask) == (can->filter[k].can_id & ~CAN_INV_FILTER & can->filter[k].can_mask);
        bool hit = can->filter[k].can_id & CAN_INV_FILTER ? !same : same;
        all &= hit;
        any |= hit;
    }
    return can->join_filters ? all : any;
}

void enqueue(can_t *can, const vb_frame_t *frame)
{
    uint32_t id;
    memcpy(&id, frame->frame, sizeof id);
    if ((can->bus != frame->bus && can->bus != -2) || !passes(can, id) || (frame->size == CANFD_MTU && !can->fd_frames)) {
        return;
    }
    if (can->written - can->read >= QUEUE_SIZE) {
        can->dropped++;
        return;
    }
    can->queue[can->written++ % QUEUE_SIZE] = *frame;
    if (can->written - can->read == 1) {
        uint64_t one = 1;
        (void)!get_write()(can->event_fd, &one, sizeof one);
    }
}

bool seen_before(int fd) /* a descriptor made by dup is another name of the same socket */
{
    for (int other = 0; other < fd; other++) {
        if (can_of[other] == can_of[fd]) {
            return true;
        }
    }
    return false;
}

static void take_frames(void)
{
    while (node->receive_read < node->receive_written) {
        const vb_frame_t *frame = &node->receive[node->receive_read % VB_RECEIVE_SIZE];
        for (int fd = 0; fd < FD_MAX; fd++) {
            if (can_of[fd] != NULL && !seen_before(fd) && (!frame->own || can_of[fd]->own)) {
                enqueue(can_of[fd], frame);
            }
        }
        node->receive_read++;
    }
}

static int64_t next_timer_ns(void)
{
    int64_t first = VB_NEVER;
    for (int fd = 0; fd < FD_MAX; fd++) {
        if (timer_of[fd] != NULL && timer_of[fd]->expiry_mono_ns < first) {
            first = timer_of[fd]->expiry_mono_ns;
        }
    }
    return first;
}

void run_timers(void)
{
    for (int fd = 0; fd < FD_MAX; fd++) {
        timer_t_ *timer = timer_of[fd];
        if (timer == NULL || timer->expiry_mono_ns > now_ns()) {
            continue;
        }
        uint64_t count = 1;
        if (timer->interval_ns > 0) {
            count += (uint64_t)((now_ns() - timer->expiry_mono_ns) / timer->interval_ns);
            timer->expiry_mono_ns += (int64_t)count * timer->interval_ns;
        } else {
            timer->expiry_mono_ns = VB_NEVER;
        }
        (void)!get_write()(timer->event_fd, &count, sizeof count);
    }
}

/* Sleep until the time, a timer, or a frame (if wanted); false: the run is over, which is told as an interrupted call. */
bool sleep_turn(int64_t until_mono_ns, bool on_frame)
{
    int saved = errno;
    claim();
    int64_t timer_ns = next_timer_ns();
    int32_t buses = 0;
    for (int fd = 0; fd < FD_MAX; fd++) {
        if (can_of[fd] != NULL) {
            buses |= can_of[fd]->bus >= 0 ? 1 << can_of[fd]->bus : can_of[fd]->bus == -2 ? ~0 : 0;
        }
    }
    node->buses = buses;
    node->wake_on_frame = on_frame;
    node->wake_mono_ns = until_mono_ns < timer_ns ? until_mono_ns : timer_ns;
    vb_store_and_wake(&node->turn, VB_TURN_BENCH);
    while (vb_wait_for(&node->turn, VB_TURN_NODE, SPINS, FOREVER_NS) < 0) {
    }
    free_calls = 0;
    take_frames();
    run_timers();
    if (region->stop) {
        end_by_stop();
        errno = EINTR;
        return false;
    }
    errno = saved;
    return true;
}

/* A program that looks again and again without sleeping would keep time still for ever: from some number of looks on, each takes a moment. */
void spend(void)
{
    if (!claimed || claimed_pid != getpid() || !pthread_equal(meeting_thread, pthread_self())) {
        return;
    }
    if (now_ns() != free_calls_at_ns) {
        free_calls_at_ns = now_ns();
        free_calls = 0;
    }
    if (++free_calls > FREE_CALLS) {
        sleep_turn(now_ns() + CALL_COST_NS, false);
        free_calls = FREE_CALLS; /* still polling: the next look takes its moment, too */
        free_calls_at_ns = now_ns();
    }
}
