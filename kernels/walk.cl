// SPDX-License-Identifier: BSD-3-Clause
// Random walks over the rows of R, which estimate x_i = sum over k >= 1 of c_k (R^k b)_i (eq. 22 to 26).
//
//   walk_rows      a walk starts at a pixel and scores b at every step; sums over the samples of the pixel
//   walk_columns   over the rows of R^T and one more, that of b, from which all walks start: a walk scores its weight
//                  at the pixel where it ends; one record a sample
//
// A step goes from i to j with probability |R_ij| / |R_i| and multiplies the weight by sign(R_ij) |R_i|; a row without
// entries ends the walk. After step k it goes on with probability steps[k].y / 2^22; steps[k].x is c_k over the
// probability to score. LINKED walks draw from a table of other probabilities, whose entry t leads to links[t], a
// column and the factors that the weights of channels take.
//
// A work-item takes WALKS chunks of CHUNK samples of one pixel, one walk of each at a time, so that their loads do not
// wait for each other. Random numbers are a function of pixel, sample, step, stream and seed, samples are summed in
// order, and arithmetic is + and * without contraction: no bit depends on WALKS, launches or devices above 2^-126.
//
// Layout: common/table.h. Chunk c of a pixel holds samples first + c CHUNK up to `end`. b is row-major with `stride`
// columns, of which offset .. offset + K - 1 are taken, of one channel after the other. Out: (units, K) sums, squares.

#pragma OPENCL FP_CONTRACT OFF

#if !defined(CHUNK) || !defined(WALKS) || !defined(LINKED) || !defined(CHANNELS) || K % CHANNELS
#error "walk.cl needs -DCHUNK, -DWALKS, -DK=<columns of b>, -DCHANNELS=<1 or 3>, -DLINKED=<0 or 1>"
#endif

#if WALKS % 4 == 0  // random numbers of four walks are made side by side
typedef ulong4 words;
#define LANES 4
#define LOAD_WORDS(p) convert_ulong4(vload4(0, p))
#define STORE_WORDS(v, p) vstore4(v, 0, p)
#else
typedef ulong words;
#define LANES 1
#define LOAD_WORDS(p) ((ulong) * (p))
#define STORE_WORDS(v, p) (*(p) = (v))
#endif

#include "common/real.h"
#include "common/table.h"

#define GO_ON_BITS 22
#define SLOT_BITS 42  // the rest of 64

// What a walk will load is asked for while others are at work: a third less time a step. The prefetch() of OpenCL
// does nothing in PoCL.
#if WALKS > 1 && defined(__clang__)
#define FETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define FETCH(p)
#endif

// The walks of a work-item, side by side; sample `next` comes next, up to `stop`.
typedef struct {
    uint pixel[WALKS], next[WALKS], stop[WALKS], row[WALKS], step[WALKS], target[WALKS];
    int alive[WALKS];
    real weight[CHANNELS][WALKS], factor[CHANNELS][WALKS];  // `factor`, `target`: what the step to come leads to
    ulong word[WALKS];  // its random number
    uint4 record[WALKS];
} walks;

// The first half of a block of Philox4x32-10 (Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As Easy as 1, 2,
// 3, SC 2011) of the counter (x, y, z, w).
static inline words philox(words x, words y, words z, words w, ulong seed)
{
    for (uint round = 0; round < 10; ++round) {
        const words a = 0xD2511F53ul * x, b = 0xCD9E8D57ul * z;
        x = (b >> 32) ^ y ^ (ulong)((uint)seed + round * 0x9E3779B9u);
        z = (a >> 32) ^ w ^ (ulong)((uint)(seed >> 32) + round * 0xBB67AE85u);
        y = b & 0xfffffffful;
        w = a & 0xfffffffful;
    }
    return y << 32 | x;
}

static inline ulong first_entry(uint4 record)
{
    return (ulong)record.y << 32 | record.x;
}

// A uniform choice of the entries of a row, by the upper bits of a word.
static inline ulong slot(uint4 record, ulong word)
{
    return first_entry(record) + ((word >> GO_ON_BITS) * record.z >> SLOT_BITS);
}

// The column and sign of one entry of the row with this record.
static inline uint draw(uint4 record, global const ulong *entries, ulong word)
{
    const ulong entry = entries[slot(record, word)], place = (word >> GO_ON_BITS) * record.z;
    const uint fraction = (uint)(place >> (SLOT_BITS - THRESHOLD_BITS)) & ((1u << THRESHOLD_BITS) - 1);
    return (uint)(fraction < (uint)(entry >> (2 * TARGET_BITS)) ? entry >> TARGET_BITS : entry) & TARGET_MASK;
}

static inline void set_out(walks *walk, int units, int chunks, uint first, uint end, global const uint *pixels)
{
    for (int w = 0; w < WALKS; ++w) {
        const int unit = min((int)get_global_id(0) * WALKS + w, units);  // the last one has nothing to do
        walk->row[w] = walk->pixel[w] = unit < units ? pixels[unit / chunks] : 0;
        walk->next[w] = first + (uint)(unit % chunks) * CHUNK;
        walk->stop[w] = unit < units ? walk->next[w] + min(end - walk->next[w], (uint)CHUNK) : walk->next[w];
    }
}

// Prepare one step of all walks: start the next samples where walks have ended, and draw. Returns whether any walk
// is under way. Walks that have ended take the step too, from their start, and nobody looks. `links` are read
// where LINKED only; `b` may be 0.
static inline int draw_steps(
    walks *walk, ulong seed, uint stream, global const uint4 *rows, global const ulong *entries,
    global const uint4 *links, global const real *b, int stride)
{
    int busy = 0;
    for (int w = 0; w < WALKS; ++w) {
        const int starts = !walk->alive[w] && walk->next[w] < walk->stop[w];
        walk->next[w] += starts;
        walk->alive[w] |= starts;
        walk->step[w] = starts ? 0 : walk->step[w];
        for (int c = 0; c < CHANNELS; ++c)
            walk->weight[c][w] = starts ? 1 : walk->weight[c][w];
        busy |= walk->alive[w];
    }
    for (int w = 0; w < WALKS; w += LANES) {
        const words x = LOAD_WORDS(walk->pixel + w), sample = LOAD_WORDS(walk->next + w) - 1;
        STORE_WORDS(philox(x, sample, LOAD_WORDS(walk->step + w), stream, seed), walk->word + w);
    }
    for (int w = 0; w < WALKS; ++w) {
        walk->record[w] = rows[walk->row[w]];
        FETCH(entries + slot(walk->record[w], walk->word[w]));
    }
    for (int w = 0; w < WALKS; ++w) {
        walk->target[w] = draw(walk->record[w], entries, walk->word[w]);
        walk->factor[0][w] = walk->record[w].z ? as_float(walk->record[w].w) : 0;
    }
#if LINKED
    for (int w = 0; w < WALKS; ++w)
        FETCH(links + first_entry(walk->record[w]) + (walk->target[w] >> 1));
    for (int w = 0; w < WALKS; ++w) {
        const uint4 record = walk->record[w];
        const uint4 link = record.z ? links[first_entry(record) + (walk->target[w] >> 1)] : (uint4)(0);
        const real factors[3] = {as_float(link.y), as_float(link.z), as_float(link.w)};
        walk->target[w] = link.x << 1;
        for (int c = 0; c < CHANNELS; ++c)
            walk->factor[c][w] = factors[c];
    }
#endif
    for (int w = 0; w < WALKS; ++w) {
        FETCH(rows + (walk->target[w] >> 1));
        if (b)
            FETCH(b + (int)(walk->target[w] >> 1) * stride);
    }
    return busy;
}

// Move walk w. Returns whether it goes on after its score; `worth`, what a score of each channel is multiplied by,
// is left as it is, 0, where the row is empty.
static inline int move(walks *walk, int w, global const uint2 *steps, real *worth)
{
    int seen = 0;
    for (int c = 0; c < CHANNELS; ++c)
        seen |= walk->factor[c][w] != 0;
    if (!seen)
        return 0;
    const uint2 step = steps[walk->step[w]++];
    walk->row[w] = walk->target[w] >> 1;
    for (int c = 0; c < CHANNELS; ++c) {
        walk->weight[c][w] *= walk->target[w] & 1 ? -walk->factor[c][w] : walk->factor[c][w];
        worth[c] = walk->weight[c][w] * as_float(step.x);
    }
    return ((uint)walk->word[w] & ((1u << GO_ON_BITS) - 1)) < step.y;
}

kernel void walk_rows(
    int units, int chunks, uint first, uint end, ulong seed, uint stream, int stride, int offset,
    global const uint *pixels, global const uint4 *rows, global const ulong *entries, global const uint4 *links,
    global const uint2 *steps, global const real *b, global float2 *out)
{
    walks walk = {{0}};
    real score[WALKS][K] = {{0}};
    float2 sums[WALKS][K] = {{0}};
    set_out(&walk, units, chunks, first, end, pixels);
    while (draw_steps(&walk, seed, stream, rows, entries, links, b, stride)) {
        for (int w = 0; w < WALKS; ++w) {
            if (!walk.alive[w])
                continue;
            real worth[CHANNELS] = {0};
            walk.alive[w] = move(&walk, w, steps, worth);
            for (int c = 0; c < K; ++c)
                score[w][c] += worth[c % CHANNELS] * b[(int)walk.row[w] * stride + offset + c];
            if (walk.alive[w])
                continue;
            walk.row[w] = walk.pixel[w];
            for (int c = 0; c < K; ++c) {
                sums[w][c] += (float2)(score[w][c], score[w][c] * score[w][c]);
                score[w][c] = 0;
            }
        }
    }
    for (int unit = get_global_id(0) * WALKS, w = 0; w < WALKS && unit < units; ++w, ++unit)
        for (int c = 0; c < K; ++c)
            out[unit * K + c] = sums[w][c];
}

// Sample s writes ends[s - first] and scores[s - first]; `pixel` is the row of b behind those of R^T.
kernel void walk_columns(
    int units, uint first, uint end, ulong seed, uint stream, global const uint *pixel, global const uint4 *rows,
    global const ulong *entries, global const uint2 *steps, global uint *ends, global real *scores)
{
    walks walk = {{0}};
    set_out(&walk, units, units, first, end, pixel);
    while (draw_steps(&walk, seed, stream, rows, entries, 0, 0, 0)) {
        for (int w = 0; w < WALKS; ++w) {
            real worth[CHANNELS] = {0};
            if (!walk.alive[w] || move(&walk, w, steps, worth))
                continue;
            const uint sample = walk.next[w] - 1 - first;
            ends[sample] = walk.row[w];
            scores[sample] = worth[0];
            walk.alive[w] = 0;
            walk.row[w] = walk.pixel[w];
        }
    }
}
