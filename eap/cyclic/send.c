/* Frames of a port, from the process image to the socket.

   eap/pd/txframe.py, publisher.py and eap/net/mmsg.py are the reference.  Left to them: frames that
   a change or an event may send, answers to polls, frames that the kernel does not take, and
   channels that do more than hand frames to a socket.  */

#include "cyclic.h"

/* ---- Patch: what a cycle writes into one prebuilt frame ---- */

/* Bits of the image (from 0), or of the inputs (from 1), and their place in the frame. */
typedef struct {
    int64_t from, source, target, bits;
} Move;

/* One origin of the values of a PD whose quality is at *target*: *word* is the first word of its
   subscription, whose header is at *header* of the image; -1 for a value of a controller.  */
typedef struct {
    int64_t target, word, header;
} Origin;

typedef struct {
    PyObject_HEAD
    Py_buffer frame, memory[2], words;
    int64_t cycle_at, cycle_ns;
    Py_ssize_t move_size, origin_size;
    Move *moves;
    Origin *origins;
} Patch;

static void patch_dealloc(Patch *self) {
    release_buffer(&self->frame);
    release_buffer(&self->memory[0]);
    release_buffer(&self->memory[1]);
    release_buffer(&self->words);
    PyMem_Free(self->moves);
    PyMem_Free(self->origins);
    free_object((PyObject *)self);
}

static int is_whole(const Move *move) { return !((move->source | move->target | move->bits) & 7); }

static int is_within(int64_t first, int64_t count, int64_t size) {
    return first >= 0 && count >= 0 && first <= size && count <= size - first;
}

/* Check all that the patch says before it is used. */
static int patch_check(const Patch *self) {
    const int64_t frame = self->frame.len, words = self->words.len / WORD;
    if (!is_within(self->cycle_at, 2, frame) || self->cycle_ns < 1 || self->cycle_ns > MAX_NS
        || words < STATION_WORDS || (uintptr_t)self->words.buf % WORD
        || self->move_size % (Py_ssize_t)sizeof(Move)
        || self->origin_size % (Py_ssize_t)sizeof(Origin))
        return refuse("a patch is cut off");
    for (Py_ssize_t n = 0; n < self->move_size / (Py_ssize_t)sizeof(Move); n++) {
        const Move *move = &self->moves[n];
        if ((move->from != 0 && move->from != 1)
            || !is_within(move->source, move->bits, 8 * self->memory[move->from].len)
            || !is_within(move->target, move->bits, 8 * frame)
            || !(is_whole(move) || move->bits <= 8))
            return refuse("a patch reaches outside of its frame or image");
    }
    for (Py_ssize_t n = 0; n < self->origin_size / (Py_ssize_t)sizeof(Origin); n++) {
        const Origin *origin = &self->origins[n];
        if (!is_within(origin->target, 2, frame)
            || !is_within(origin->word, origin->header < 0 ? 1 : RX_WORDS, words)
            || (origin->header >= 0
                && !is_within(origin->header, PD_HEADER, self->memory[0].len)))
            return refuse("a patch reaches outside of its frame or image");
    }
    return 0;
}

/* Patch(frame, cycle_at, memories, words, cycle_ns, moves, origins): buffer of the frame, offset of
   its cycle counter; image and inputs; words of the image; the station's cycle time.  */
static PyObject *patch_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *frame, *image, *inputs, *words;
    const char *moves, *origins;
    long long cycle_at, cycle_ns;
    Patch *self = (Patch *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    if (PyArg_ParseTuple(args, "OL(OO)OLy#y#", &frame, &cycle_at, &image, &inputs, &words,
                         &cycle_ns, &moves, &self->move_size, &origins, &self->origin_size)
        && !PyObject_GetBuffer(frame, &self->frame, PyBUF_CONTIG)
        && !PyObject_GetBuffer(image, &self->memory[0], PyBUF_CONTIG_RO)
        && !PyObject_GetBuffer(inputs, &self->memory[1], PyBUF_CONTIG_RO)
        && !PyObject_GetBuffer(words, &self->words, PyBUF_CONTIG_RO)
        && (self->moves = copy_of(moves, self->move_size)) != NULL
        && (self->origins = copy_of(origins, self->origin_size)) != NULL) {
        self->cycle_at = cycle_at;
        self->cycle_ns = cycle_ns;
        if (!patch_check(self))
            return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

/* As Gather.bits_into(), for one variable. */
static void move_bits(const Move *move, const uint8_t *memory, uint8_t *frame) {
    const unsigned mask = (1u << move->bits) - 1;
    const uint8_t *source = memory + (move->source >> 3);
    uint8_t *target = frame + (move->target >> 3);
    unsigned shift = move->source & 7, value = source[0];
    if (shift + move->bits > 8)
        value |= (unsigned)source[1] << 8;
    value = value >> shift & mask;
    shift = move->target & 7;
    target[0] = (uint8_t)((target[0] & ~(mask << shift)) | value << shift);
    if (shift + move->bits > 8)
        target[1] = (uint8_t)((target[1] & ~(mask << shift >> 8)) | value << shift >> 8);
}

/* As quality() and field_quality(). */
static int64_t quality_of(const Patch *self, const Origin *origin) {
    const int64_t *words = self->words.buf;
    if (origin->header < 0) {
        int64_t at_ns = load(&words[origin->word]);
        int64_t age_ns = load(&words[STATION_CYCLE_AT_NS]) - at_ns;
        return at_ns == 0 ? QUALITY_MAX : age_ns < 0 ? 0 : age_ns / QUALITY_NS;
    }
    int64_t first = load(&words[origin->word + RX_TRACKER]);
    if (first == 0)
        first = origin->word;
    if (!is_within(first, RX_WORDS, self->words.len / WORD)
        || !load(&words[first + RX_RECEIVED]))
        return QUALITY_MAX;
    int64_t cycles = load(&words[STATION_CYCLE])
                     - load(&words[first + RX_RECEIVED + ARRIVED_IN_CYCLE]);
    if (cycles > MAX_NS / self->cycle_ns)
        return QUALITY_MAX;
    int64_t age_ns = (cycles > 0 ? cycles : 0) * self->cycle_ns
                     + load(&words[origin->word + RX_RESPONSE_NS]);
    const uint8_t *header = (uint8_t *)self->memory[0].buf + origin->header;
    return (header[PD_QUALITY] | header[PD_QUALITY + 1] << 8) + age_ns / QUALITY_NS;
}

static void patch_run(const Patch *self, int64_t cycle) {
    uint8_t *frame = self->frame.buf;
    frame[self->cycle_at] = (uint8_t)cycle;
    frame[self->cycle_at + 1] = (uint8_t)(cycle >> 8);
    const Move *end = self->moves + self->move_size / (Py_ssize_t)sizeof(Move);
    for (const Move *move = self->moves; move < end; move++) {
        const uint8_t *memory = self->memory[move->from].buf;
        if (is_whole(move))
            memmove(frame + (move->target >> 3), memory + (move->source >> 3),
                    (size_t)(move->bits >> 3));
        else
            move_bits(move, memory, frame);
    }
    const Origin *last = self->origins + self->origin_size / (Py_ssize_t)sizeof(Origin);
    int64_t oldest = 0;
    for (const Origin *origin = self->origins; origin < last; origin++) {
        int64_t age = quality_of(self, origin);
        if (age > oldest)
            oldest = age > QUALITY_MAX ? QUALITY_MAX : age;
        if (origin + 1 == last || origin[1].target != origin->target) {
            frame[origin->target] = (uint8_t)oldest;
            frame[origin->target + 1] = (uint8_t)(oldest >> 8);
            oldest = 0;
        }
    }
}

/* patch(cycle): write the counter, the data and the qualities of all PDs. */
static PyObject *patch_call(Patch *self, PyObject *args, PyObject *keywords) {
    long long cycle;
    (void)keywords;
    if (!PyArg_ParseTuple(args, "L", &cycle))
        return NULL;
    patch_run(self, cycle);
    Py_RETURN_NONE;
}

static PyType_Slot patch_slots[] = {
    {Py_tp_new, patch_new}, {Py_tp_dealloc, patch_dealloc}, {Py_tp_call, patch_call}, {0, NULL},
};
PyType_Spec patch_spec = {
    "eap._cyclic.Patch", sizeof(Patch), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    patch_slots,
};

/* ---- SendPlan: the frames of a port that go by their schedule alone ---- */

/* A frame is due in each cycle that leaves *phase* divided by *step*; two words count it. */
typedef struct {
    int64_t step, phase, whole, sent_at;
} Row;

typedef struct {
    PyObject_HEAD
    PyObject *frames, *patches;
    PyObject *direct, *addresses;  /* sender that the headers were made for */
    Py_buffer words;
    Row *rows;
    struct mmsghdr *headers, *due;
    struct iovec *vectors;
    Py_ssize_t count, row_size;
    int fd;
} SendPlan;

static void plan_dealloc(SendPlan *self) {
    Py_XDECREF(self->frames);
    Py_XDECREF(self->patches);
    Py_XDECREF(self->direct);
    Py_XDECREF(self->addresses);
    release_buffer(&self->words);
    PyMem_Free(self->rows);
    PyMem_Free(self->headers);
    PyMem_Free(self->due);
    PyMem_Free(self->vectors);
    free_object((PyObject *)self);
}

static int plan_check(SendPlan *self) {
    size_t count = (size_t)self->count;
    if (PyList_Size(self->patches) != self->count || (uintptr_t)self->words.buf % WORD
        || self->row_size != self->count * (Py_ssize_t)sizeof(Row)
        || self->words.len < STATION_WORDS * WORD)
        return refuse("a plan has a patch and a row for each frame");
    self->headers = PyMem_Calloc(count + 1, sizeof *self->headers);
    self->due = PyMem_Calloc(count + 1, sizeof *self->due);
    self->vectors = PyMem_Calloc(count + 1, sizeof *self->vectors);
    if (self->headers == NULL || self->due == NULL || self->vectors == NULL) {
        PyErr_NoMemory();
        return -1;
    }
    for (Py_ssize_t n = 0; n < self->count; n++) {
        const Row *row = &self->rows[n];
        const Patch *patch = (Patch *)PyList_GetItem(self->patches, n);
        if (!Py_IS_TYPE((PyObject *)patch, patch_type) || row->step < 1
            || !is_within(row->whole, 1, self->words.len / WORD)
            || !is_within(row->sent_at, 1, self->words.len / WORD))
            return refuse("a frame of a plan is none, or reaches outside of the image");
        self->vectors[n].iov_base = patch->frame.buf;
        self->vectors[n].iov_len = (size_t)patch->frame.len;
        self->headers[n].msg_hdr.msg_iov = &self->vectors[n];
        self->headers[n].msg_hdr.msg_iovlen = 1;
    }
    return 0;
}

/* SendPlan(frames, patches, rows, words) */
static PyObject *plan_new(PyTypeObject *type, PyObject *args, PyObject *keywords) {
    PyObject *frames, *patches, *words;
    const char *rows;
    SendPlan *self = (SendPlan *)make_object(type, keywords);
    if (self == NULL)
        return NULL;
    if (PyArg_ParseTuple(args, "O!O!y#O", &PyTuple_Type, &frames, &PyTuple_Type, &patches, &rows,
                         &self->row_size, &words)) {
        self->count = PyTuple_Size(frames);
        self->frames = PySequence_List(frames);
        self->patches = PySequence_List(patches);
        if (self->frames != NULL && self->patches != NULL
            && (self->rows = copy_of(rows, self->row_size)) != NULL
            && !PyObject_GetBuffer(words, &self->words, PyBUF_CONTIG) && !plan_check(self))
            return (PyObject *)self;
    }
    Py_DECREF(self);
    return NULL;
}

/* Describe all frames to the kernel for *direct*, a SendBatch. */
static int direct_to(SendPlan *self, PyObject *direct) {
    PyObject *addresses = PyList_New(self->count);
    int fd = PyObject_AsFileDescriptor(direct);
    if (addresses == NULL || fd < 0)
        goto failed;
    for (Py_ssize_t n = 0; n < self->count; n++) {
        PyObject *frame = PyList_GetItem(self->frames, n);
        PyObject *address = PyObject_CallMethodObjArgs(direct, text_address_of, frame, NULL);
        if (address == NULL || PyList_SetItem(addresses, n, address))
            goto failed;
        if (!PyBytes_Check(address)) {
            refuse("an address is packed into bytes");
            goto failed;
        }
        Py_ssize_t size = PyBytes_Size(address);
        self->headers[n].msg_hdr.msg_name = size ? PyBytes_AsString(address) : NULL;
        self->headers[n].msg_hdr.msg_namelen = (socklen_t)size;
    }
    Py_XDECREF(self->addresses);
    self->addresses = addresses;
    Py_INCREF(direct);
    Py_XDECREF(self->direct);
    self->direct = direct;
    self->fd = fd;
    return 0;
failed:
    Py_XDECREF(addresses);
    Py_CLEAR(self->direct);  /* the headers may have lost their addresses */
    return -1;
}

/* Send the first *count* of the due frames in one call; return how many the kernel took, or -1. */
static int transmit(SendPlan *self, Py_ssize_t count) {
    struct mmsghdr *headers = count == self->count ? self->headers : self->due;
    if (count > 1)
        return sendmmsg(self->fd, headers, (unsigned)count, MSG_DONTWAIT);
    const struct msghdr *only = &headers->msg_hdr;
    return sendto(self->fd, only->msg_iov->iov_base, only->msg_iov->iov_len, MSG_DONTWAIT,
                  only->msg_name, only->msg_namelen) < 0 ? -1 : 1;
}

static int is_due(const Row *row, int64_t cycle) { return cycle % row->step == row->phase; }

/* Return the frames that are due as a list. */
static PyObject *due_frames(const SendPlan *self, int64_t cycle) {
    PyObject *frames = PyList_New(0);
    for (Py_ssize_t n = 0; frames != NULL && n < self->count; n++)
        if (is_due(&self->rows[n], cycle)
            && PyList_Append(frames, PyList_GetItem(self->frames, n)))
            Py_CLEAR(frames);
    return frames;
}

/* Send the due frames through *channel*; return those that were not sent, NULL for an error. */
static PyObject *send_frames(SendPlan *self, PyObject *channel, Py_ssize_t count, int64_t cycle,
                             PyObject *now) {
    PyObject *failed = NULL, *frames = NULL, *direct = PyObject_GetAttr(channel, text_direct);
    if (direct == NULL)
        return NULL;
    if (direct != Py_None) {
        if (direct != self->direct && direct_to(self, direct))
            goto done;
        if (count < self->count) {
            struct mmsghdr *to = self->due;
            for (Py_ssize_t n = 0; n < self->count; n++)
                if (is_due(&self->rows[n], cycle))
                    *to++ = self->headers[n];
        }
        int sent = transmit(self, count), number = errno;
        if (sent == count) {
            Py_INCREF(Py_None);
            failed = Py_None;
        } else if ((frames = due_frames(self, cycle)) != NULL)
            failed = PyObject_CallMethod(direct, "go_on", "Oii", frames, sent, number);
    } else if ((frames = due_frames(self, cycle)) != NULL)
        failed = PyObject_CallMethodObjArgs(channel, text_send, frames, now, NULL);
done:
    Py_XDECREF(frames);
    Py_DECREF(direct);
    return failed;
}

int send_due(PyObject *plan, PyObject *publisher, PyObject *channel, PyObject *now) {
    SendPlan *self = (SendPlan *)plan;
    int64_t *words = self->words.buf, now_ns = PyLong_AsLongLong(now);
    if (now_ns == -1 && PyErr_Occurred())
        return -1;
    const int64_t cycle = load(&words[STATION_CYCLE]);
    Py_ssize_t count = 0;
    for (Py_ssize_t n = 0; n < self->count; n++)
        if (is_due(&self->rows[n], cycle)) {
            patch_run((Patch *)PyList_GetItem(self->patches, n), cycle);
            count++;
        }
    if (!count)
        return 0;
    PyObject *failed = send_frames(self, channel, count, cycle, now);
    int any = failed == NULL ? -1 : PyObject_IsTrue(failed);
    if (any > 0) {
        PyObject *done = PyObject_CallMethod(publisher, "sent_partly", "LOO", (long long)cycle,
                                             failed, now);
        any = done == NULL ? -1 : 1;
        Py_XDECREF(done);
    }
    for (Py_ssize_t n = 0; !any && n < self->count; n++)
        if (is_due(&self->rows[n], cycle)) {
            add(&words[self->rows[n].whole], 1);
            store(&words[self->rows[n].sent_at], now_ns);
        }
    Py_XDECREF(failed);
    return any < 0 ? -1 : 0;
}

static PyType_Slot plan_slots[] = {
    {Py_tp_new, plan_new}, {Py_tp_dealloc, plan_dealloc}, {0, NULL},
};
PyType_Spec send_plan_spec = {
    "eap._cyclic.SendPlan", sizeof(SendPlan), 0, Py_TPFLAGS_DEFAULT | Py_TPFLAGS_IMMUTABLETYPE,
    plan_slots,
};
