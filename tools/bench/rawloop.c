/* The limit of the machine: the least that C does with the same bytes over a raw socket.
 *
 *     rawloop MODE INTERFACE FRAME PAGE SECONDS BATCH
 *
 * MODE: send, receive, send_paced, receive_stamps as in raw_roles.py; station, which receives and
 * sends one PD each millisecond; exchange, which sends a frame and waits for it, as a master does in
 * a cycle; segment, which returns frames as slaves in OP do, their process data unchanged; or line,
 * which sends the frames of the solar line to itself by UDP and receives them in each cycle.  FRAME is a file with an Ethernet frame, PAGE the words that the
 * processes share.  With a BATCH above 1 a call of sendmmsg or recvmmsg moves so many frames; with 0
 * a receiver never sleeps.  tools/bench/rawloop.py defines where counter, stamp and data are.
 */
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <fcntl.h>
#include <net/if.h>
#include <netinet/in.h>
#include <netpacket/packet.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

enum { RECEIVED, STOP, MOST = 64, ROOM = 2048, SKIPPED = 50, SAMPLES = 200000 };
static volatile int64_t *page;
static unsigned char frames[MOST][ROOM], image[ROOM];
static struct iovec parts[MOST];
static struct mmsghdr messages[MOST];
static int sock, batch, size;

static int64_t clock_ns(clockid_t which)
{
    struct timespec at;
    clock_gettime(which, &at);
    return at.tv_sec * 1000000000LL + at.tv_nsec;
}

static int64_t now_ns(void) { return clock_ns(CLOCK_MONOTONIC); }

static void sleep_until(int64_t due_ns)
{
    struct timespec at = {due_ns / 1000000000, due_ns % 1000000000};
    clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
}

static uint16_t counter(const unsigned char *frame)
{
    uint16_t value;
    memcpy(&value, frame + CYCLE_AT, sizeof value);
    return value;
}

static int by_size(const void *left, const void *right)
{
    int64_t a = *(const int64_t *)left, b = *(const int64_t *)right;
    return (a > b) - (a < b);
}

static void send_all(double seconds)
{
    int64_t start = now_ns(), end = start + (int64_t)(seconds * 1e9), sent = 0;
    while (now_ns() < end) {
        if (sent - page[RECEIVED] >= WINDOW)
            continue;
        for (int done = 0; done < BURST; done += batch) {
            for (int n = 0; n < batch; n++) {
                uint16_t cycle = ++sent;
                memcpy(frames[n] + CYCLE_AT, &cycle, sizeof cycle);
            }
            if (batch == 1)
                send(sock, frames[0], size, 0);
            else
                sendmmsg(sock, messages, batch, 0);
        }
    }
    while (page[RECEIVED] < sent && now_ns() < end + ARRIVED_WITHIN_NS)
        ;
    printf("{\"sent\":%lld,\"seconds\":%f}\n", (long long)sent, (now_ns() - start) / 1e9);
}

static void receive_all(int flags)
{
    int64_t received = 0, lost = 0;
    uint16_t last = 0;
    while (!page[STOP]) {
        int count = batch > 1 ? recvmmsg(sock, messages, batch, flags | MSG_WAITFORONE, NULL)
                              : recv(sock, frames[0], ROOM, flags) > 0;
        for (int n = 0; n < count; n++) {
            uint16_t cycle = counter(frames[n]);
            lost += (uint16_t)(cycle - last - 1);
            last = cycle;
            received++;
        }
        page[RECEIVED] = received;
    }
    printf("{\"received\":%lld,\"lost\":%lld}\n", (long long)received, (long long)lost);
}

static void send_paced(double seconds)
{
    int64_t due = now_ns(), count = (int64_t)(seconds * 1e9 / CYCLE_NS);
    for (int64_t n = 0; n < count; n++) {
        sleep_until(due += CYCLE_NS);
        int64_t at = now_ns();
        memcpy(frames[0] + DATA_AT, &at, sizeof at);
        send(sock, frames[0], size, 0);
    }
    printf("{\"sent\":%lld}\n", (long long)count);
}

static void receive_stamps(void)
{
    static int64_t late[SAMPLES];
    int64_t sent, count = 0;
    while (!page[STOP]) {
        if (recv(sock, frames[0], ROOM, 0) <= 0)
            continue;
        memcpy(&sent, frames[0] + DATA_AT, sizeof sent);
        if (count < SAMPLES)
            late[count++] = now_ns() - sent;
    }
    if ((count -= SKIPPED) <= 0)
        exit(1);
    qsort(late + SKIPPED, count, sizeof *late, by_size);
    printf("{\"count\":%lld,\"p50\":%lld,\"p99\":%lld,\"max\":%lld}\n", (long long)count,
           (long long)late[SKIPPED + count / 2], (long long)late[SKIPPED + count * 99 / 100],
           (long long)late[SKIPPED + count - 1]);
}

static void station(double seconds)
{
    int64_t begin = now_ns(), due = begin, received = 0, lost = 0, sent = 0;
    int64_t used = clock_ns(CLOCK_PROCESS_CPUTIME_ID);
    uint16_t last = 0, cycle = 0;
    while (!page[STOP] && due < begin + (int64_t)(seconds * 1e9)) {
        sleep_until(due += CYCLE_NS);
        while (recv(sock, frames[1], ROOM, MSG_DONTWAIT) > 0) {
            memcpy(image, frames[1] + DATA_AT, size - DATA_AT);
            lost += received++ ? (uint16_t)(counter(frames[1]) - last - 1) : 0;
            last = counter(frames[1]);
        }
        cycle++;
        memcpy(frames[0] + CYCLE_AT, &cycle, sizeof cycle);
        memcpy(frames[0] + DATA_AT, image, size - DATA_AT);
        send(sock, frames[0], size, 0);
        sent++;
    }
    used = clock_ns(CLOCK_PROCESS_CPUTIME_ID) - used;
    printf("{\"cpu\":%f,\"sent\":%lld,\"received\":%lld,\"lost\":%lld}\n",
           (double)used / (now_ns() - begin), (long long)sent, (long long)received, (long long)lost);
}

static void exchange(double seconds)
{
    int64_t begin = now_ns(), end = begin + (int64_t)(seconds * 1e9), count = 0;
    while (now_ns() < end) {
        frames[0][INDEX_AT]++;
        send(sock, frames[0], size, 0);
        while (recv(sock, frames[1], ROOM, MSG_DONTWAIT) <= 0 || frames[1][INDEX_AT] != frames[0][INDEX_AT])
            if (now_ns() > end)
                break;
        memcpy(image, frames[1] + DATAGRAM_AT, size - DATAGRAM_AT);
        count++;
    }
    printf("{\"cycles\":%lld,\"seconds\":%f}\n", (long long)count, (now_ns() - begin) / 1e9);
}

static void segment(void)
{
    unsigned char *frame = frames[0];
    while (!page[STOP]) {
        int length = recv(sock, frame, ROOM, MSG_DONTWAIT), at = DATAGRAM_AT, more = 1;
        if (length <= 0)
            continue;
        while (more && at + DATAGRAM_HEADER + 2 <= length) {
            int field = frame[at + 6] | frame[at + 7] << 8, end = at + DATAGRAM_HEADER + (field & 0x7ff);
            if (end + 2 > length)
                break;
            if (frame[at] == LRW) {
                frame[end] += 3 * SLAVES; /* each reads and writes, ETG.1000.4 */
            } else if (frame[at] == FPRD || frame[at] == BRD) {
                frame[end] += frame[at] == BRD ? SLAVES : 1;
                memset(frame + at + DATAGRAM_HEADER, 0, field & 0x7ff);
                if ((frame[at + 4] | frame[at + 5] << 8) == AL_STATUS)
                    frame[at + DATAGRAM_HEADER] = OP;
            }
            more = field & 0x8000;
            at = end + 2;
        }
        frame[6] |= 2; /* the first slave does so, ETG.1000.4 */
        send(sock, frame, length, 0);
    }
}

static void line(double seconds)
{
    enum { MIXED = LINE_SMALL + LINE_LARGE };
    struct sockaddr_in own = {.sin_family = AF_INET, .sin_addr = {htonl(INADDR_LOOPBACK)}};
    socklen_t length = sizeof own;
    int udp = socket(AF_INET, SOCK_DGRAM, 0), buffer = 1 << 20;
    setsockopt(udp, SOL_SOCKET, SO_RCVBUFFORCE, &buffer, sizeof buffer);
    if (bind(udp, (struct sockaddr *)&own, length) || getsockname(udp, (struct sockaddr *)&own, &length)
        || connect(udp, (struct sockaddr *)&own, length))
        exit(1);
    int64_t begin = now_ns(), due = begin, received = 0, sent = 0;
    int64_t used = clock_ns(CLOCK_PROCESS_CPUTIME_ID);
    while (due < begin + (int64_t)(seconds * 1e9)) {
        sleep_until(due += LINE_CYCLE_NS);
        for (int n = 0; n < MIXED; n++)
            parts[n].iov_len = ROOM;
        int count = recvmmsg(udp, messages, MIXED, MSG_DONTWAIT, NULL);
        for (int n = 0; n < count; n++)
            memcpy(image, frames[n], messages[n].msg_len);
        received += count > 0 ? count : 0;
        for (int n = 0; n < MIXED; n++)
            parts[n].iov_len = HEADERS + (n < LINE_SMALL ? LINE_SMALL_SIZE : LINE_LARGE_SIZE);
        for (int n = 0; n < MIXED; n++)
            memcpy(frames[n] + HEADERS, image, parts[n].iov_len - HEADERS);
        sent += sendmmsg(udp, messages, MIXED, 0);
    }
    used = clock_ns(CLOCK_PROCESS_CPUTIME_ID) - used;
    printf("{\"cpu\":%f,\"sent\":%lld,\"received\":%lld}\n", (double)used / (now_ns() - begin),
           (long long)sent, (long long)received);
}

int main(int argc, char **argv)
{
    if (argc != 7)
        return 2;
    const char *mode = argv[1];
    double seconds = atof(argv[5]);
    int spins = !atoi(argv[6]), flags = spins ? MSG_DONTWAIT : 0, buffer = 8 << 20;
    batch = spins ? 1 : atoi(argv[6]);
    struct sockaddr_ll to = {.sll_family = AF_PACKET, .sll_protocol = htons(ETHERTYPE),
                             .sll_ifindex = (int)if_nametoindex(argv[2])};
    struct timeval within = {0, 100000};
    int file = open(argv[3], O_RDONLY), words = open(argv[4], O_RDWR);
    page = mmap(NULL, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, words, 0);
    sock = socket(AF_PACKET, SOCK_RAW, htons(ETHERTYPE));
    if (batch > MOST || (size = (int)read(file, frames[0], ROOM)) < DATA_AT || page == MAP_FAILED
        || bind(sock, (struct sockaddr *)&to, sizeof to)
        || setsockopt(sock, SOL_SOCKET, SO_RCVBUFFORCE, &buffer, sizeof buffer)
        || setsockopt(sock, SOL_SOCKET, SO_RCVTIMEO, &within, sizeof within)) {
        perror("rawloop");
        return 1;
    }
    for (int n = 0; n < MOST; n++) {
        memcpy(frames[n], frames[0], size);
        parts[n] = (struct iovec){frames[n], size};
        messages[n].msg_hdr.msg_iov = &parts[n];
        messages[n].msg_hdr.msg_iovlen = 1;
    }
    if (strncmp(mode, "send", 4)) {
        puts("{\"ready\":true}");
        fflush(stdout);
    }
    if (!strcmp(mode, "send"))
        send_all(seconds);
    else if (!strcmp(mode, "receive"))
        receive_all(flags);
    else if (!strcmp(mode, "send_paced"))
        send_paced(seconds);
    else if (!strcmp(mode, "receive_stamps"))
        receive_stamps();
    else if (!strcmp(mode, "station"))
        station(seconds);
    else if (!strcmp(mode, "exchange"))
        exchange(seconds);
    else if (!strcmp(mode, "segment"))
        segment();
    else if (!strcmp(mode, "line"))
        line(seconds);
    return 0;
}
