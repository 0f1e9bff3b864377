// SPDX-License-Identifier: BSD-3-Clause
// Random walks over the rows of R, which estimate x_i = sum over k >= 1 of c_k (R^k b)_i (eq. 22 to
// 26).
//
//   walk_rows     a walk starts at a pixel and scores b at every step; sums over the samples of the
//                 pixel
//   walk_columns  over the rows of R^T and one more, that of b, from which all walks start: a walk
//                 scores its weight at the pixel where it ends; one record a sample
//   walk_tables   the alias tables that both draw from; one work-item a row
//
// A step goes from i to j with probability |R_ij| / |R_i| and multiplies the weight by sign(R_ij)
// |R_i|; a row without entries ends the walk. After step k it goes on with probability
// steps[k].y / 2^22; steps[k].x is c_k over the probability to score. LINKED walks draw from other
// probabilities: entry t leads to links[t], a column and the factors of the weights of all
// channels.
//
// A work-item takes WALKS chunks of CHUNK samples of one pixel, one walk of each at a time: their
// loads overlap. Random numbers depend on pixel, sample, step, stream and seed, samples are summed
// in order, and a * b + c is not contracted: no bit depends on WALKS, launches or devices above
// 2^-126.
//
// Required defines: CHUNK; WALKS; K, columns of b; CHANNELS, 1 or 3; LINKED, 0 or 1.
//
// Layout: unit u is chunk u % chunks of pixel u / chunks, and chunk c of a pixel holds the samples
// first + c CHUNK up to `end`. Of the `stride` columns of b those from `offset` on are taken, of
// one channel after the other.
//   rows     a record each: x, y: place of the first entry, low word first; z: number of entries, 0
//            where there is nothing to draw; w: the sum |R_i|, the bits of a real
//   entries  one load of 64 bits each:
//            threshold 18 | own column 22, sign 1 | alias column 22, sign 1
//   links    x: column; y, z, w: the factors of the channels, bits of reals

#pragma OPENCL FP_CONTRACT OFF

#if !defined(CHUNK) || !defined(WALKS)
#error "walk.cl needs -DCHUNK=<samples of a chunk>, -DWALKS=<chunks of a work-item>"
#endif
#ifndef LINKED
#error "walk.cl needs -DLINKED=<0 or 1>"
#endif
#if !defined(CHANNELS) || K % CHANNELS
#error "walk.cl needs -DCHANNELS=<1 or 3>, -DK=<columns of b, a multiple of CHANNELS>"
#endif

#include "common/real.h"

#define THRESHOLD_BITS 18
#define THRESHOLD_MASK ((1u << THRESHOLD_BITS) - 1)
#define TARGET_BITS 23  // a column and its sign
#define TARGET_MASK ((1u << TARGET_BITS) - 1)
#define GO_ON_BITS 22
#define SLOT_BITS 42  // the rest of 64

// Loads asked for ahead: a third less time a step. The prefetch() of OpenCL does nothing in PoCL.
// Only where clang compiles for the CPU itself: SPIR-V, through which others pass, has no such
// instruction.
#if WALKS > 1 && defined(__clang__) && (defined(__x86_64__) || defined(__aarch64__))
#define FETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define FETCH(p)
#endif

// The walks of a work-item, side by side.
typedef struct {
    uint pixel[WALKS];
    uint next[WALKS], stop[WALKS];  // samples to come: next .. stop - 1
    uint row[WALKS], step[WALKS];
    uint target[WALKS];  // column and sign that the step to come leads to
    int alive[WALKS];
    real weight[CHANNELS][WALKS];
    real factor[CHANNELS][WALKS];  // of the weight, by the step to come
    ulong word[WALKS];             // random number of the step to come
    uint4 record[WALKS];
} walks;

// Half a block of Philox4x32-10 (Salmon et al., Parallel Random Numbers: As Easy as 1, 2, 3, SC
// 2011) at (x, y, z, w).
INLINE void philox(walks *walk, uint stream, ulong seed)
{
    ulong x[WALKS], y[WALKS], z[WALKS], w[WALKS];
    for (int i = 0; i < WALKS; ++i) {
        x[i] = walk->pixel[i];
        y[i] = walk->next[i] - 1;
        z[i] = walk->step[i];
        w[i] = stream;
    }
    for (uint round = 0; round < 10; ++round)
        for (int i = 0; i < WALKS; ++i) {
            const ulong a = 0xD2511F53ul * x[i], b = 0xCD9E8D57ul * z[i];
            x[i] = (b >> 32) ^ y[i] ^ (ulong)((uint)seed + round * 0x9E3779B9u);
            z[i] = (a >> 32) ^ w[i] ^ (ulong)((uint)(seed >> 32) + round * 0xBB67AE85u);
            y[i] = b & 0xfffffffful;
            w[i] = a & 0xfffffffful;
        }
    for (int i = 0; i < WALKS; ++i)
        walk->word[i] = y[i] << 32 | x[i];
}

#define FIRST_ENTRY(record) ((ulong)(record).y << 32 | (record).x)

// A uniform choice of the entries of a row, by the upper bits of a word.
INLINE ulong slot(uint4 record, ulong word)
{
    return FIRST_ENTRY(record) + ((word >> GO_ON_BITS) * record.z >> SLOT_BITS);
}

INLINE void
set_out(walks *walk, int units, int chunks, uint first, uint end, global const uint *pixels)
{
    for (int w = 0; w < WALKS; ++w) {
        // The one behind the last unit has nothing to do.
        const int unit = min((int)get_global_id(0) * WALKS + w, units);
        walk->row[w] = walk->pixel[w] = unit < units ? pixels[unit / chunks] : 0;
        walk->next[w] = first + (uint)(unit % chunks) * CHUNK;
        walk->stop[w] =
            unit < units ? walk->next[w] + min(end - walk->next[w], (uint)CHUNK) : walk->next[w];
    }
}

// Prepare one step of all walks: start the next samples where walks have ended, and draw. Returns
// whether any walk is under way; the others take a step that does not count. `links` are read where
// LINKED only; `b` may be 0.
INLINE int draw_steps(
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
    philox(walk, stream, seed);
    for (int w = 0; w < WALKS; ++w) {
        walk->record[w] = rows[walk->row[w]];
        FETCH(entries + slot(walk->record[w], walk->word[w]));
    }
    for (int w = 0; w < WALKS; ++w) {
        const uint4 record = walk->record[w];
        const ulong entry = entries[slot(record, walk->word[w])];
        const ulong place = (walk->word[w] >> GO_ON_BITS) * record.z;
        const uint fraction = (uint)(place >> (SLOT_BITS - THRESHOLD_BITS)) & THRESHOLD_MASK;
        const bool own = fraction < (uint)(entry >> (2 * TARGET_BITS));
        walk->target[w] = (uint)(own ? entry >> TARGET_BITS : entry) & TARGET_MASK;
        walk->factor[0][w] = record.z ? as_float(record.w) : 0;
    }
#if LINKED
    for (int w = 0; w < WALKS; ++w)
        FETCH(links + FIRST_ENTRY(walk->record[w]) + (walk->target[w] >> 1));
    for (int w = 0; w < WALKS; ++w) {
        const uint4 record = walk->record[w];
        const ulong place = FIRST_ENTRY(record) + (walk->target[w] >> 1);
        const uint4 link = record.z ? links[place] : (uint4)(0);
        walk->target[w] = link.x << 1;
        for (int c = 0; c < CHANNELS; ++c)
            walk->factor[c][w] = as_float(c == 0 ? link.y : c == 1 ? link.z : link.w);
    }
#endif
    for (int w = 0; w < WALKS; ++w) {
        FETCH(rows + (walk->target[w] >> 1));
        if (b)
            FETCH(b + (int)(walk->target[w] >> 1) * stride);
    }
    return busy;
}

// Move walk w. Returns whether it goes on after its score, which counts `worth` times: unchanged by
// an empty row.
INLINE int move(walks *walk, int w, global const uint2 *steps, real *worth)
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

// Walks from pixels: scores of b, summed over the samples of a unit.
kernel void walk_rows(
    int units,                    // chunks of all pixels
    int chunks,                   // of a pixel
    uint first,                   // sample of each pixel
    uint end,                     // sample behind the last of each pixel
    ulong seed,                   // of the random numbers
    uint stream,                  // of the random numbers
    int stride,                   // columns of b in all
    int offset,                   // the first of the K columns taken
    global const uint *pixels,    // where walks start
    global const uint4 *rows,     // see above
    global const ulong *entries,  // see above
    global const uint4 *links,    // see above; read where LINKED
    global const uint2 *steps,    // x: worth of a score, bits of a real; y: chance to go on
    global const real *b,         // (pixels, stride)
    global float2 *out)           // (units, K), sums and squares of the scores
{
    walks walk = {{0}};
    real score[WALKS][K] = {{0}};
    float2 sums[WALKS][K] = {{0}};
    set_out(&walk, units, chunks, first, end, pixels);
    while (draw_steps(&walk, seed, stream, rows, entries, links, b, stride))
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
    for (int unit = get_global_id(0) * WALKS, w = 0; w < WALKS && unit < units; ++w, ++unit)
        for (int c = 0; c < K; ++c)
            out[unit * K + c] = sums[w][c];
}

// Walks from b: where each sample ended, and its score. Sample s is at s - first.
kernel void walk_columns(
    int units,                    // chunks of samples
    uint first,                   // sample of this launch
    uint end,                     // sample behind the last
    ulong seed,                   // of the random numbers
    uint stream,                  // of the random numbers
    global const uint *pixel,     // [1], the row of b behind those of R^T
    global const uint4 *rows,     // see above
    global const ulong *entries,  // see above
    global const uint2 *steps,    // x: worth of a score, bits of a real; y: chance to go on
    global uint *ends,            // [end - first]
    global real *scores)          // [end - first]
{
    walks walk = {{0}};
    set_out(&walk, units, units, first, end, pixel);
    while (draw_steps(&walk, seed, stream, rows, entries, 0, 0, 0))
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

// Alias tables for drawing the entries of a row in proportion to |R_ij| (eq. 25): Walker's (1974),
// by one sweep over light and heavy entries (Huebschle-Schneider and Sanders, Parallel Weighted
// Random Sampling, ESA 2019), in integers: of n bins each has room for C, the sum of the row scaled
// by the largest power of two, and entry t has the mass n |R_it|. Rounding moves less than 2^-18 of
// a row's probability, in total variation, of up to 2^20 entries.

#define BIT_LENGTH(x) (64 - (int)clz((ulong)(x)))

// |value| 2^(150 + shift) of the bits of a real, rounded to the nearest integer.
INLINE ulong scaled(uint value, int shift)
{
    const uint bits = value & 0x7fffffffu, exponent = bits >> 23;
    const ulong significand = exponent ? (bits & 0x7fffffu) | 0x800000u : bits;
    const int left = (int)max(exponent, 1u) + shift;
    if (left >= 0)
        return significand << left;
    return left < -25 ? 0 : ((significand >> (-left - 1)) + 1) >> 1;
}

INLINE ulong scaled_sum(global const uint *values, uint n, int shift)
{
    ulong sum = 0;
    for (uint t = 0; t < n; ++t)
        sum += scaled(values[t], shift);
    return sum;
}

#define TARGET(t) ((ulong)(columns ? (uint)columns[t] : t) << 1 | values[t] >> 31)
#define MASS(t) (n * scaled(values[t], shift))
#define NEXT(t, test) \
    do \
        ++t; \
    while (t < n && !(MASS(t) test capacity))

INLINE void fill_bins(
    global const uint *values, global const int *columns, uint n, int shift, ulong capacity,
    global ulong *out)
{
    uint light = ~0u, heavy = ~0u;
    NEXT(light, <=);
    NEXT(heavy, >);
    ulong left = heavy < n ? MASS(heavy) : 0;
    while (light < n || heavy < n) {
        uint own = heavy, other = heavy;
        ulong mass = left;
        if (heavy >= n || left > capacity) {
            // The light one's bin, filled up by the heavy one, or full already.
            own = light;
            mass = MASS(light);
            left -= capacity - mass;
            NEXT(light, <=);
        } else {
            // The rest of the heavy one is its own bin, filled up by the next.
            NEXT(heavy, >);
            if (heavy < n) {
                left += MASS(heavy) - capacity;
                other = heavy;
            }
        }
        ulong threshold = ((mass << THRESHOLD_BITS) + capacity / 2) / capacity;
        // A full bin, as all are once no heavy one is left: no mass is lost.
        if (threshold >> THRESHOLD_BITS) {
            other = own;
            threshold = 0;
        }
        out[own] = threshold << (2 * TARGET_BITS) | TARGET(own) << TARGET_BITS | TARGET(other);
    }
}

// Records and entries of the rows of a slab.
kernel void walk_tables(
    int rows,                    // rows of the slab
    int first,                   // record of the first of them
    ulong base,                  // entry of the first of them
    int width,                   // entries of a dense row
    global const int *pointers,  // [rows + 1], where sparse rows begin within the slab; 0 of dense
    global const int *columns,   // of each entry of sparse rows; 0 of dense rows
    global const uint *values,   // of each entry, the bits of reals
    global uint4 *records,       // the rows of walk_rows
    global ulong *entries)       // the entries of walk_rows
{
    const int row = get_global_id(0);
    if (row >= rows)
        return;
    const ulong begin = pointers ? (ulong)pointers[row] : (ulong)row * width, start = base + begin;
    const uint n = pointers ? pointers[row + 1] - pointers[row] : width;
    values += begin;
    columns = columns ? columns + begin : 0;
    uint largest = 0, sum = 0;
    for (uint t = 0; t < n; ++t)
        largest = max(largest, values[t] & 0x7fffffffu);
    if (largest) {
        // With this shift the largest entry becomes a number of 31 bits.
        const int rough = 7 - (int)max(largest >> 23, 1u);
        // The sum gets as many bits as fit: n C must be below 2^63, C 2^18 as well.
        const ulong rough_sum = scaled_sum(values, n, rough);
        const int spare = min(45, 63 - BIT_LENGTH(n)) - 1 - BIT_LENGTH(rough_sum + n);
        const ulong capacity = scaled_sum(values, n, rough + spare);
        fill_bins(values, columns, n, rough + spare, capacity, entries + start);
        const real total = ldexp(convert_float(capacity), -150 - rough - spare);  // may be infinite
        sum = total < 0x1p-126f ? 0 : as_uint(total);
    }
    records[first + row] = (uint4)((uint)start, (uint)(start >> 32), sum ? n : 0, sum);
}
