// SPDX-License-Identifier: BSD-3-Clause
// Random walks over the rows of R, which estimate x_i = sum over k >= 1 of c_k (R^k b)_i (eq. 22 to 26).
//
//   walk_rows      sums over the samples of a pixel: the walk starts there and reads b where it comes
//   walk_columns   the adjoint: the walk ends at a pixel and writes what it brings there, one record a sample;
//                  rows are those of R^T, and one more row, from which all walks start, is that of b
//
// A step goes from i to j with probability |R_ij| / |R_i| and multiplies the weight by sign(R_ij) |R_i|, so that
// the products of eq. 26 cancel. After step k the walk goes on with probability steps[k].y / 2^22; what it then
// is worth is weight * b_j * steps[k].x, where steps[k].x holds c_k over the probability to be scored there: at
// every step (COLLISION) or where the walk ends, the paper's eq. 26. Rows without entries end a walk.
//
// LINKED walks step by a table of other probabilities: entry t of its row leads to links[t], a column and what
// the weight of each channel is multiplied by there. So colour channels share a walk.
//
// A work-item takes WALKS chunks of CHUNK samples of one pixel, one walk of each at a time: their loads do not
// wait for each other. Samples of a chunk are summed in order, with the rounding errors of the sums kept
// (Knuth's two-sum). So no bit depends on WALKS, nor on how chunks are spread over work-items. Arithmetic is + and *
// in this order, without contraction: the same bits on every device, as long as nothing falls below 2^-126.
//
// Random numbers have no state: a block of Philox is a function of its counter, here pixel, sample, step / 2 and
// stream, and of the seed; a step takes half a block.
// Layout: tables as in common/table.h. Chunk c of a pixel holds samples first + c CHUNK up to `end`; `chunks`
// chunks a pixel. b is row-major with `stride` columns, of which offset .. offset + K - 1 are taken, the first
// of channel 0, the next of channel 1 and so on. Out of walk_rows: (units, K) of (sum, its rounding, sum of
// squares, its rounding).

#pragma OPENCL FP_CONTRACT OFF

#if !defined(CHUNK) || !defined(WALKS) || !defined(COLLISION) || !defined(LINKED) || !defined(PREFETCH) \
    || !defined(CHANNELS) || K % CHANNELS
#error "walk.cl needs -DCHUNK, -DWALKS, -DK=<columns of b>, -DCHANNELS=<1 or 3>; 0 or 1: -DCOLLISION -DLINKED -DPREFETCH"
#endif

#define GO_ON_BITS 22
#define SLOT_BITS 42  // the rest of 64

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

// Where an item has several walks, what one will load is asked for while the others are at work: a third
// less time a step. The language's own prefetch() does nothing in PoCL; Oclgrind does not know this one.
#if PREFETCH && defined(__clang__)
#define FETCH(p) __builtin_prefetch((const void *)(size_t)(p))
#else
#define FETCH(p)
#endif

// Philox4x32-10 of Salmon, Moraes, Dror and Shaw, Parallel Random Numbers: As Easy as 1, 2, 3 (SC 2011): the block
// of counter (x, y, z, w) in its place, each word in the lower half of a lane.
static inline void philox(words *x, words *y, words *z, words *w, uint key, uint other_key)
{
    for (uint round = 0; round < 10; ++round) {
        const words a = 0xD2511F53ul * *x, b = 0xCD9E8D57ul * *z;
        *x = (b >> 32) ^ *y ^ (ulong)(key + round * 0x9E3779B9u);
        *z = (a >> 32) ^ *w ^ (ulong)(other_key + round * 0xBB67AE85u);
        *y = b & 0xfffffffful;
        *w = a & 0xfffffffful;
    }
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

// sum + its rounding += value, both kept side by side
static inline void two_sum(real value, real *sum)
{
    const real total = sum[0] + value, added = total - sum[0];
    sum[1] += (sum[0] - (total - added)) + (value - added);
    sum[0] = total;
}

// The walks of a work-item, side by side.
typedef struct {
    uint pixel[WALKS], next[WALKS], stop[WALKS];  // sample `next` comes next, up to `stop`
    uint row[WALKS], step[WALKS];
    int alive[WALKS];
    real weight[CHANNELS][WALKS];
    ulong word[WALKS];  // of the step to come, with the record of its row, where it leads and by what factor
    uint4 record[WALKS];
    uint target[WALKS];
    real factor[CHANNELS][WALKS];
} walks;

static inline void set_out(walks *walk, int units, int chunks, uint first, uint end, global const uint *pixels)
{
    for (int w = 0; w < WALKS; ++w) {
        const int unit = get_global_id(0) * WALKS + w;
        const int known = unit < units;
        walk->row[w] = walk->pixel[w] = known ? pixels[unit / chunks] : 0;
        walk->next[w] = first + (uint)(known ? unit % chunks : 0) * CHUNK;
        walk->stop[w] = known ? walk->next[w] + min(end - walk->next[w], (uint)CHUNK) : walk->next[w];
        walk->step[w] = walk->alive[w] = 0;
        for (int c = 0; c < CHANNELS; ++c)
            walk->weight[c][w] = 0;
    }
}

// Prepare one step of all walks: start the next samples where walks have ended, draw the words of the step and
// ask for the table entries that it will take. Returns whether any walk is under way. Walks that have ended
// take the step too, from their start, and nobody looks.
static inline int set_off(
    walks *walk, ulong seed, uint stream, global const uint4 *rows, global const ulong *entries)
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
        const words step = LOAD_WORDS(walk->step + w);
        words x = LOAD_WORDS(walk->pixel + w), y = LOAD_WORDS(walk->next + w) - 1, z = step / 2, other = stream;
        philox(&x, &y, &z, &other, (uint)seed, (uint)(seed >> 32));
        STORE_WORDS(select(y << 32 | x, other << 32 | z, step << 63), walk->word + w);
    }
    for (int w = 0; w < WALKS; ++w) {
        walk->record[w] = rows[walk->row[w]];
        FETCH(entries + slot(walk->record[w], walk->word[w]));
    }
    return busy;
}

// The columns and signs that the walks step to, and what weights are multiplied by, 0 where the row is empty.
// `links` are read where LINKED only; `b` may be 0.
static inline void draw_targets(
    walks *walk, global const uint4 *rows, global const ulong *entries, global const uint4 *links,
    global const real *b, int stride)
{
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
}

// Move walk w; returns whether it goes on after its score, and in `worth` what a score of each channel is
// multiplied by: left as it is, 0, where the row is empty.
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
    global const uint2 *steps, global const real *b, global real4 *out)
{
    walks walk;
    real score[WALKS][K] = {{0}}, sums[WALKS][K][4] = {{{0}}};
    set_out(&walk, units, chunks, first, end, pixels);
    while (set_off(&walk, seed, stream, rows, entries)) {
        draw_targets(&walk, rows, entries, links, b, stride);
        for (int w = 0; w < WALKS; ++w) {
            if (!walk.alive[w])
                continue;
            real worth[CHANNELS] = {0};
            walk.alive[w] = move(&walk, w, steps, worth);
            if (COLLISION || !walk.alive[w])
                for (int c = 0; c < K; ++c)
                    score[w][c] += worth[c % CHANNELS] * b[(int)walk.row[w] * stride + offset + c];
            if (walk.alive[w])
                continue;
            walk.row[w] = walk.pixel[w];
            for (int c = 0; c < K; ++c) {
                two_sum(score[w][c], sums[w][c]);
                two_sum(score[w][c] * score[w][c], sums[w][c] + 2);
                score[w][c] = 0;
            }
        }
    }
    for (int w = 0; w < WALKS; ++w) {
        const int unit = get_global_id(0) * WALKS + w;
        if (unit < units)
            for (int c = 0; c < K; ++c)
                out[unit * K + c] = vload4(0, sums[w][c]);
    }
}

// Sample s writes ends[s - first] and scores[s - first]; `pixel` is the row of b behind those of R^T.
kernel void walk_columns(
    int units, uint first, uint end, ulong seed, uint stream, global const uint *pixel, global const uint4 *rows,
    global const ulong *entries, global const uint2 *steps, global uint *ends, global real *scores)
{
    walks walk;
    set_out(&walk, units, units, first, end, pixel);
    while (set_off(&walk, seed, stream, rows, entries)) {
        draw_targets(&walk, rows, entries, 0, 0, 0);
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
