/* Exchange of a master while nothing but process data is under way: frames of a cycle.

   devicebus/master/link.py and cycle.py are the reference.  A frame that comes back with another
   header or working counter is left to them, and the state that they need is in the words.  */

#include "cyclic.h"

/* Words as QuietWord of devicebus/master/quietcycle.py has them. */
enum { UNTIL_NS, INDEX, SENT_NS, NEXT_INDEX, INDEXES, TIMEOUT_NS, SMOOTHED_NS, VARIATION_NS,
       FLOOR_NS, CEILING_NS, SENT, BACK, CYCLES, GOOD, WKC, TRIP_NS, MAX_TRIP_NS, IS_GOOD,
       TIME_NS, HAS_TIME, FULL, QUIET_SIZE };
/* Offsets in a frame, and in the header of a datagram (ETG.1000.4). */
enum { ETHERCAT_HEADER = 2, DATAGRAM_HEADER = 10, OVERHEAD = DATAGRAM_HEADER + 2 };
enum { AT_INDEX = 1, AT_ADP = 2, AT_ADO = 4, AT_LENGTH = 6, TYPE_DATAGRAM = 1 };
enum { LENGTH = 0x07FF, MORE = 0x8000, MAILBOX_FULL = 0x08, MAX_LOOKS = 32 };
enum { NOT_TAKEN, TAKEN_WHOLE, TAKEN_WITH_NOTES };

typedef struct {
    int64_t in_frame, in_image, size;
} Move;

typedef struct {
    int64_t at, expected;
} Check;

typedef struct {
    PyObject_HEAD
    Py_buffer words, outputs, inputs;
    uint8_t *octets;  /* its own, for the lengths in it are relied on */
    Move *writes, *reads;
    Check *checks;
    int64_t *looks;
    Py_ssize_t size, write_size, read_size, check_size, look_size, time_at;
} CycleFrame;

static void frame_dealloc(CycleFrame *self) {
    release_buffer(&self->words);
    release_buffer(&self->outputs);
    release_buffer(&self->inputs);
    PyMem_Free(self->octets);
    PyMem_Free(self->writes);
    PyMem_Free(self->reads);
    PyMem_Free(self->checks);
    PyMem_Free(self->looks);
    free_object((PyObject *)self);
}

static int word_at(const uint8_t *octets) { return octets[0] | octets[1] << 8; }

static int fits(int64_t first, int64_t size, Py_ssize_t whole) {
    return first >= 0 && size >= 0 && size <= whole && first <= whole - size;
}

/* Check that the frame is one, to its end, and that all moves are within it. */
static int frame_check(const CycleFrame *self) {
    const uint8_t *octets = self->octets;
    Py_ssize_t size = self->size, at = ETHERCAT_HEADER;
    for (int more = 1; more; ) {
        if (!fits(at, OVERHEAD, size))
            return refuse("the frame of a cycle is cut off");
        int word = word_at(octets + at + AT_LENGTH);
        at += OVERHEAD + (word & LENGTH);
        more = word & MORE;
    }
    if (at != size || octets[1] >> 4 != TYPE_DATAGRAM)
        return refuse("the frame of a cycle has another size");
    const struct {
        const Move *moves;
        Py_ssize_t size, image;
    } both[] = {{self->writes, self->write_size, self->outputs.len},
                {self->reads, self->read_size, self->inputs.len}};
    for (int n = 0; n < 2; n++)
        for (Py_ssize_t i = 0; i < both[n].size / (Py_ssize_t)sizeof(Move); i++) {
            const Move *move = &both[n].moves[i];
            if (!fits(move->in_frame, move->size, size)
                || !fits(move->in_image, move->size, both[n].image))
                return refuse("a copy of a cycle lies outside of its frame or image");
        }
    for (Py_ssize_t n = 0; n < self->check_size / (Py_ssize_t)sizeof(Check); n++)
        if (!fits(self->checks[n].at, 2, size))
            return refuse("a working counter lies outside of its frame");
    for (Py_ssize_t n = 0; n < self->look_size / WORD; n++)
        if (!fits(self->looks[n], 3, size))
            return refuse("a status lies outside of its frame");
    if (self->time_at >= 0 && !fits(self->time_at, 10, size))
        return refuse("a time lies outside of its frame");
    return 0;
}

/* CycleFrame(octets, words, outputs, inputs, writes, reads, checks, looks, time_at): the prepared
   frame; writes and reads as offset in the frame, in outputs or inputs, and size; checks as offset
   and value of working counters; looks as offsets of the status of mailboxes; offset of the time of
   the reference clock, -1 without one.  */
static PyObject *frame_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *words, *outputs, *inputs;
    const char *octets, *writes, *reads, *checks, *looks;
    CycleFrame *self = (CycleFrame *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    if (!PyArg_ParseTuple(args, "y#OOOy#y#y#y#n", &octets, &self->size, &words, &outputs,
                          &inputs, &writes, &self->write_size, &reads, &self->read_size, &checks,
                          &self->check_size, &looks, &self->look_size, &self->time_at)
        || PyObject_GetBuffer(words, &self->words, PyBUF_CONTIG)
        || PyObject_GetBuffer(outputs, &self->outputs, PyBUF_SIMPLE)
        || PyObject_GetBuffer(inputs, &self->inputs, PyBUF_CONTIG))
        goto failed;
    if (self->words.len != QUIET_SIZE * WORD || (uintptr_t)self->words.buf % WORD
        || self->write_size % (Py_ssize_t)sizeof(Move) || self->read_size % (Py_ssize_t)sizeof(Move)
        || self->check_size % (Py_ssize_t)sizeof(Check) || self->look_size % WORD
        || self->look_size > MAX_LOOKS * WORD) {
        refuse("the words or copies of a cycle are cut off");
        goto failed;
    }
    if ((self->octets = copy_of(octets, self->size)) != NULL
        && (self->writes = copy_of(writes, self->write_size)) != NULL
        && (self->reads = copy_of(reads, self->read_size)) != NULL
        && (self->checks = copy_of(checks, self->check_size)) != NULL
        && (self->looks = copy_of(looks, self->look_size)) != NULL && !frame_check(self))
        return (PyObject *)self;
failed:
    Py_DECREF(self);
    return NULL;
}

/* send(now_ns): return this cycle's frame; None if it is not quiet any more. */
static PyObject *frame_send(CycleFrame *self, PyObject *number) {
    int64_t *words = self->words.buf;
    uint8_t *octets = self->octets;
    long long now_ns = PyLong_AsLongLong(number);
    if (now_ns == -1 && PyErr_Occurred())
        return NULL;
    int64_t index = load(&words[NEXT_INDEX]), indexes = load(&words[INDEXES]);
    if (load(&words[INDEX]) >= 0 || now_ns >= load(&words[UNTIL_NS]) || !is_time(now_ns)
        || indexes < 1 || indexes > 256 || index < 0 || index >= indexes)
        Py_RETURN_NONE;
    for (const Move *move = self->writes;
         move < self->writes + self->write_size / (Py_ssize_t)sizeof(Move); move++)
        memcpy(octets + move->in_frame, (const char *)self->outputs.buf + move->in_image,
               (size_t)move->size);
    for (Py_ssize_t at = ETHERCAT_HEADER; at < self->size;
         at += OVERHEAD + (word_at(octets + at + AT_LENGTH) & LENGTH))
        octets[at + AT_INDEX] = (uint8_t)index;
    PyObject *frame = PyBytes_FromStringAndSize((const char *)octets, self->size);
    if (frame == NULL)
        return NULL;
    store(&words[INDEX], index);
    store(&words[NEXT_INDEX], index + 1 == indexes ? 0 : index + 1);
    store(&words[SENT_NS], now_ns);
    store(&words[IS_GOOD], 0);
    add(&words[SENT], 1);
    add(&words[CYCLES], 1);
    return frame;
}

/* Whether no slave changes the ADP of a command: those by station, FRMW, and the logical ones. */
static int keeps_adp(int command) {
    return (command >= 4 && command <= 6) || (command >= 10 && command <= 12) || command == 14;
}

/* As PreparedFrame.matches(). */
static int frame_matches(const CycleFrame *self, const uint8_t *data, Py_ssize_t size,
                         int64_t index) {
    const uint8_t *octets = self->octets;
    if (size < self->size || data[1] >> 4 != TYPE_DATAGRAM)
        return 0;
    for (Py_ssize_t at = ETHERCAT_HEADER; at < self->size; ) {
        const uint8_t *sent = octets + at, *back = data + at;
        int length = word_at(sent + AT_LENGTH) & LENGTH;
        int first = keeps_adp(sent[0]) ? AT_ADP : AT_ADO;
        if (sent[0] != back[0] || back[AT_INDEX] != index
            || memcmp(sent + first, back + first, (size_t)(AT_LENGTH - first))
            || length != (word_at(back + AT_LENGTH) & LENGTH))
            return 0;
        at += OVERHEAD + length;
    }
    return 1;
}

/* As RoundTrip.measure(). */
static void measure(int64_t *words, int64_t trip_ns) {
    int64_t smoothed_ns = load(&words[SMOOTHED_NS]), variation_ns = load(&words[VARIATION_NS]);
    if (!smoothed_ns) {
        smoothed_ns = trip_ns;
        variation_ns = trip_ns >> 1;
    } else {
        int64_t difference_ns = trip_ns - smoothed_ns;
        variation_ns += ((difference_ns < 0 ? -difference_ns : difference_ns) - variation_ns) >> 2;
        smoothed_ns += difference_ns >> 3;
    }
    if (smoothed_ns < 1)
        smoothed_ns = 1;
    int64_t timeout_ns = smoothed_ns + 4 * variation_ns;
    if (timeout_ns < load(&words[FLOOR_NS]))
        timeout_ns = load(&words[FLOOR_NS]);
    else if (timeout_ns > load(&words[CEILING_NS]))
        timeout_ns = load(&words[CEILING_NS]);
    store(&words[SMOOTHED_NS], smoothed_ns);
    store(&words[VARIATION_NS], variation_ns);
    store(&words[TIMEOUT_NS], timeout_ns);
}

/* Note the time of the reference clock, and which mailboxes are full; return whether there is any. */
static int note_others(const CycleFrame *self, const uint8_t *data) {
    int64_t *words = self->words.buf, full = 0;
    uint64_t time_ns = 0;
    int has_time = self->time_at >= 0 && word_at(data + self->time_at + WORD);
    for (int n = WORD; has_time && n > 0; n--)
        time_ns = time_ns << 8 | data[self->time_at + n - 1];
    for (Py_ssize_t n = 0; n < self->look_size / WORD; n++) {
        const uint8_t *status = data + self->looks[n];
        if (*status & MAILBOX_FULL && word_at(status + 1))
            full |= 1LL << n;
    }
    store(&words[TIME_NS], (int64_t)time_ns);
    store(&words[HAS_TIME], has_time);
    store(&words[FULL], full);
    return has_time || full;
}

/* Take the frame if it is the one that was sent, with the working counters of all slaves. */
static int frame_take(const CycleFrame *self, const uint8_t *data, Py_ssize_t size,
                      int64_t now_ns) {
    int64_t *words = self->words.buf, sum = 0, index = load(&words[INDEX]);
    int64_t sent_ns = load(&words[SENT_NS]);
    if (index < 0 || !is_time(now_ns) || !is_time(sent_ns)
        || !frame_matches(self, data, size, index))
        return NOT_TAKEN;
    const Check *checks_end = self->checks + self->check_size / (Py_ssize_t)sizeof(Check);
    for (const Check *check = self->checks; check < checks_end; check++) {
        if (word_at(data + check->at) != check->expected)
            return NOT_TAKEN;
        sum += check->expected;
    }
    for (const Move *move = self->reads;
         move < self->reads + self->read_size / (Py_ssize_t)sizeof(Move); move++)
        memmove((char *)self->inputs.buf + move->in_image, data + move->in_frame,
                (size_t)move->size);
    measure(words, now_ns - sent_ns);
    store(&words[INDEX], -1);
    store(&words[TRIP_NS], now_ns - sent_ns);
    if (now_ns - sent_ns > load(&words[MAX_TRIP_NS]))
        store(&words[MAX_TRIP_NS], now_ns - sent_ns);
    store(&words[WKC], sum);
    store(&words[IS_GOOD], 1);
    add(&words[GOOD], 1);
    add(&words[BACK], 1);
    return note_others(self, data) ? TAKEN_WITH_NOTES : TAKEN_WHOLE;
}

/* receive(data, now_ns): take a frame that came back; return 0 if it is left to Python, 1 if it is
   taken, 2 if the words also have a time or full mailboxes to handle.  */
static PyObject *frame_receive(CycleFrame *self, PyObject *args) {
    Py_buffer data;
    long long now_ns;
    if (!PyArg_ParseTuple(args, "y*L", &data, &now_ns))
        return NULL;
    int taken = frame_take(self, data.buf, data.len, now_ns);
    PyBuffer_Release(&data);
    return PyLong_FromLong(taken);
}

static PyMethodDef frame_methods[] = {
    {"send", (PyCFunction)frame_send, METH_O, NULL},
    {"receive", (PyCFunction)frame_receive, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};
static PyType_Slot frame_slots[] = {
    {Py_tp_new, frame_new}, {Py_tp_dealloc, frame_dealloc}, {Py_tp_methods, frame_methods},
    {0, NULL},
};
PyType_Spec cycle_frame_spec = {
    "eap._cyclic.CycleFrame", sizeof(CycleFrame), 0,
    Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE, frame_slots,
};
