/* Compiled part of the cyclic path; Python code is the reference for all of it.

   Each file decides before it changes anything whether a case is the usual one, and leaves others to
   Python, so each of them is handled by one of the two alone.  Nothing here keeps state of its own
   but the offset of two clocks: plans, trackers and counters are those of Python.

   Limited API of CPython 3.11.  The GIL is held throughout but for the wait between two cycles: no
   other call blocks, and a cycle that gave it up would have to wait for the thread that prepares a
   change.  */

#ifndef EAP_CYCLIC_H
#define EAP_CYCLIC_H

#define _GNU_SOURCE
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <structmember.h>

#include <errno.h>
#include <stdint.h>
#include <string.h>
#include <sys/socket.h>

/* Words of the image, and other numbers that Python compares as OFFSETS. */
enum { STATION_CYCLE, STATION_CYCLE_AT_NS, STATION_FUTEX, STATION_WAITERS, STATION_SEQUENCE,
       STATION_SERVICES, STATION_APPLICATION, STATION_OVERRUNS = 14, STATION_LATENESS_MAX_NS = 16,
       STATION_LATENESS = 34, BINS = 64, STATION_SAMPLED_UNTIL = STATION_LATENESS + BINS + 1,
       STATION_WORDS };
enum { RX_TRACKER, RX_RESPONSE_NS = 3, RX_RECEIVED = 26 };
/* Of a tracker, which begins at RX_RECEIVED of its block and reaches to the end. */
enum { RECEIVED, DUPLICATED, REORDERED, LATE, STATE = 7, LAST_CYCLE, ARRIVED_AT_NS,
       ARRIVED_IN_CYCLE, BEHIND, JITTER_MAX_US = 15, JITTER, TRACKER_WORDS = JITTER + BINS,
       RX_WORDS = RX_RECEIVED + TRACKER_WORDS };
enum { CYCLE_AT = 10, FIRST_PD = 14, PD_HEADER = 8, SHORTEST = FIRST_PD + PD_HEADER,
       PD_LENGTH = 4, PD_QUALITY = 6 };
enum { QUALITY_MAX = 0xFFFF, QUALITY_NS = 100000, WAKE_FOR_CYCLES = 100 };
enum { WORD = sizeof(int64_t), MAX_INDEX = 1 << 30 };
/* Times and periods that are computed with: far below an overflow of their sums and products. */
#define MAX_NS (1LL << 61)

typedef enum { LEFT_TO_PYTHON, TAKEN, FAILED = -1 } Result;

/* A word has one writer; readers in other processes copy without a lock. */
static inline int64_t load(const int64_t *word) { return __atomic_load_n(word, __ATOMIC_RELAXED); }

static inline void store(int64_t *word, int64_t value) {
    __atomic_store_n(word, value, __ATOMIC_RELAXED);
}

static inline void add(int64_t *word, int64_t more) {
    store(word, (int64_t)((uint64_t)load(word) + (uint64_t)more));
}

static inline int is_time(int64_t ns) { return ns >= 0 && ns <= MAX_NS; }

/* Bin of a histogram, as histogram_bin(). */
static inline int bin_of(int64_t micros) {
    if (micros < 4)
        return micros < 0 ? 0 : (int)micros;
    int exponent = 64 - __builtin_clzll((unsigned long long)micros);
    if (exponent > 17)
        return BINS - 1;
    return 4 * (exponent - 2) + (int)(micros >> (exponent - 3) & 3);
}

/* Set ValueError, and return -1. */
int refuse(const char *what);

/* Raise *needed* to the end of *count* words or bytes from *first* on; refuse negative numbers. */
int need(int64_t *needed, int64_t first, int64_t count);

/* Make an object of *type*, which takes no keywords; free one whose parts are gone. */
PyObject *make_object(PyTypeObject *type, PyObject *keywords);
void free_object(PyObject *self);

/* Return a copy of *octets* that is aligned for words. */
void *copy_of(const char *octets, Py_ssize_t size);

/* Release *buffer*, so that nothing can be read there any more. */
void release_buffer(Py_buffer *buffer);

/* ---- receive.c: PortHandler, receive_frame() of one port ---- */

typedef struct {
    PyObject_HEAD
    PyObject *fallback, *learner, *plans, *weak_references;
    Py_buffer memory, words;
    long long open_from_ns;
} PortHandler;

/* Take a frame, of which all *size* bytes are there, if it is a usual one. */
Result take(PortHandler *self, const uint8_t *data, Py_ssize_t size, int64_t at_ns,
            const uint8_t *source, Py_ssize_t source_size);

/* ---- batch.c ---- */

typedef struct {
    PyObject_HEAD
    PyObject *receiver, *handlers, *origin, *sender;
    int fd;
    char may_drain, may_send;
} Socket;

/* Hand over what waits at a socket; return how many frames had a handler, or -1. */
Py_ssize_t drain(Socket *self);

/* ---- send.c ---- */

/* A publisher of a station, its channel, its SendPlan, and the Socket of the channel. */
typedef struct {
    PyObject *publisher, *channel, *plan, *socket;
} Outlet;

/* A cycle and its time, which is there twice. */
typedef struct {
    int64_t number, now_ns;
    PyObject *now;
} Moment;

/* Send the frames that are due, and count them, if all are in the plan. */
Result send_due(const Outlet *outlet, const Moment *moment);

/* ---- Types, made by module.c, and interned texts ---- */

extern PyTypeObject *plan_type, *handler_type, *receiver_type, *socket_type, *patch_type,
    *send_plan_type;
extern PyType_Spec plan_spec, handler_spec, receiver_spec, socket_spec, patch_spec, send_plan_spec,
    cycle_spec, waiter_spec, cycle_frame_spec, copies_spec, source_steps_spec;
extern PyObject *text_fast, *text_source, *text_source_of, *text_wanted;

#endif
