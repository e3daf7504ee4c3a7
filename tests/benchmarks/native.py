"""C programs of the benchmarks: the responder behind the PTY and the bare loop that is the floor of every client.

They are generated into a temporary folder and compiled there. Where no compiler is found, `compiled` returns None: the
responder is then the Python one, and the tables have no row for the C loop.
"""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

COMPILERS = ("cc", "gcc", "clang")

RESPONDER = r"""
/* usage: responder FD COUNTERS. Answers SMS frames from a table of bytes; COUNTERS receives two 64-bit counts. */
#include <fcntl.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <unistd.h>

enum { PING = 1, READ = 2, WRITE = 3, REG_WRITE = 4, ACTION = 5, SYNC_READ = 0x82, SYNC_WRITE = 0x83, EVERYBODY = 0xFE };
static const unsigned char image[256] = {IMAGE};
static unsigned char memory[256][256], pending[256][256], in[65536], out[65536];
static unsigned pending_size[256];

static unsigned reply(unsigned at, unsigned id, const unsigned char *data, unsigned size) {
    unsigned char *p = out + at, sum = id + size + 2;
    p[0] = p[1] = 0xFF; p[2] = id; p[3] = size + 2; p[4] = 0;
    for (unsigned i = 0; i < size; i++) { p[5 + i] = data[i]; sum += data[i]; }
    p[5 + size] = ~sum;
    return at + 6 + size;
}

static void store(unsigned id, unsigned address, const unsigned char *data, unsigned size) {
    for (unsigned i = 0; i < size; i++) memory[id][(address + i) & 255] = data[i];
}

int main(int argc, char **argv) {
    int fd = atoi(argv[1]), file = open(argv[2], O_RDWR);
    volatile uint64_t *counts = mmap(0, 16, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    unsigned have = 0;
    for (unsigned id = 0; id < 256; id++) { memcpy(memory[id], image, 256); memory[id][5] = id; }
    for (;;) {
        ssize_t size = read(fd, in + have, sizeof in - have);
        unsigned at = 0, answered = 0;
        if (size <= 0) return 0;
        have += size;
        while (have - at >= 6) {
            const unsigned char *p = in + at, *params = p + 5;
            unsigned id = p[2], length = p[3] + 4, count = p[3] - 2, step;
            if (p[0] != 0xFF || p[1] != 0xFF) { at++; continue; }
            if (have - at < length) break;
            switch (p[4]) {
            case PING: answered = reply(answered, id, params, 0); break;
            case READ: answered = reply(answered, id, memory[id] + params[0], params[1]); break;
            case WRITE:
                store(id, params[0], params + 1, count - 1);
                if (id != EVERYBODY) answered = reply(answered, id, params, 0);
                break;
            case REG_WRITE:
                memcpy(pending[id], params, count); pending_size[id] = count;
                answered = reply(answered, id, params, 0);
                break;
            case ACTION:
                for (unsigned i = 0; i < 256; i++)
                    if (pending_size[i]) { store(i, pending[i][0], pending[i] + 1, pending_size[i] - 1); pending_size[i] = 0; }
                break;
            case SYNC_READ:
                for (unsigned i = 2; i < count; i++)
                    answered = reply(answered, params[i], memory[params[i]] + params[0], params[1]);
                break;
            case SYNC_WRITE:
                step = params[1] + 1;
                counts[0]++;
                for (unsigned i = 2; i + step <= count; i += step) {
                    store(params[i], params[0], params + i + 1, params[1]);
                    counts[1]++;
                }
                break;
            }
            at += length;
        }
        memmove(in, in + at, have - at);
        have -= at;
        for (unsigned sent = 0; sent < answered;) {
            ssize_t n = write(fd, out + sent, answered - sent);
            if (n <= 0) return 0;
            sent += n;
        }
    }
}
"""

LOOP = r"""
/* usage: loop PORT SECONDS REPLY_SIZE FRAME_IN_HEX. Prints turns, seconds and seconds of CPU. */
#include <fcntl.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>
#include <unistd.h>

static double now(clockid_t id) { struct timespec t; clock_gettime(id, &t); return t.tv_sec + 1e-9 * t.tv_nsec; }

int main(int argc, char **argv) {
    unsigned char frame[256], reply[256];
    int fd = open(argv[1], O_RDWR | O_NOCTTY), expected = atoi(argv[3]), size = strlen(argv[4]) / 2;
    double seconds = atof(argv[2]), began = now(CLOCK_MONOTONIC), cpu = now(CLOCK_PROCESS_CPUTIME_ID), elapsed;
    long turns = 0;
    for (int i = 0; i < size; i++) { unsigned byte; sscanf(argv[4] + 2 * i, "%2x", &byte); frame[i] = byte; }
    do {
        if (write(fd, frame, size) != size) return 1;
        for (int missing = expected; missing;) {
            int n = read(fd, reply, missing);
            if (n <= 0) return 1;
            missing -= n;
        }
        turns++;
    } while ((elapsed = now(CLOCK_MONOTONIC) - began) < seconds);
    printf("%ld %.6f %.6f\n", turns, elapsed, now(CLOCK_PROCESS_CPUTIME_ID) - cpu);
    return 0;
}
"""


def compiled(source: str, folder: Path, name: str) -> Path | None:
    """The path of the program, or None where this machine has no C compiler."""
    compiler = next((path for path in map(shutil.which, COMPILERS) if path), None)
    if compiler is None:
        return None
    (folder / f"{name}.c").write_text(source)
    program = folder / name
    subprocess.run([compiler, "-O2", "-o", str(program), str(folder / f"{name}.c")], check=True, timeout=60)
    return program
