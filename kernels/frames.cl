// SPDX-License-Identifier: BSD-3-Clause
// Frames of a prepared compensation, from the codes of a file to those of the projector:
//
//   frames_decode  light to add = gain * light of the codes - background
//   frames_clip    projector light within the bounds, as the unknowns of a solve
//   frames_encode  projector light within the bounds, as codes
//   frames_peaks   how much of the way to the upper bound each strip of pixels goes
//
// Codes are (pixels, colours), row-major. Light is one value a pixel and channel: channels stand
// side by side, or, with -DSTACKED=1, one below the other. The projector light of channel c is
//
//   p_c = sum_d mixing[3 c + d] factors_d direct_d    with MIXED, else factors_c direct_c,
//
// and 0 where the factor of c is 0: at masked pixels. A work-item takes `span` neighbouring pixels,
// BLOCK of them at a time, channel by channel: light stands in private memory between loops that do
// one thing each, so that a CPU takes wide registers for all but the tables.
//
// Required defines: CODE, the type of codes: uchar, ushort or float; CHANNELS of the light, 1 or 3;
// STACKED. Optional: BLOCK, 1 by default. Of frames_decode also COLOURS of a code, 1 or CHANNELS,
// and TABLE, 1 if a table tells the light of each code, 0 if codes are light; KEPT, 1 if the light
// of bounces is that of an earlier frame. Of the others MIXED. Of frames_encode STEPS: 0 if
// codes are light; else codes are places in an ascending list of light, `thresholds`, of which less
// than 2^STEPS lie within a cell; BETWEEN, 1 for places between two of them; ROUNDED, 1 to round
// these to whole numbers.

#include "common/real.h"

#ifndef CODE
#error "frames.cl needs -DCODE=<type of codes: uchar, ushort or float>"
#endif
#ifndef CHANNELS
#error "frames.cl needs -DCHANNELS=<of the light: 1 or 3>"
#endif
#ifndef COLOURS
#define COLOURS CHANNELS
#endif
#ifndef BLOCK
#define BLOCK 1
#endif
#ifndef KEPT
#define KEPT 0
#endif
#ifndef MIXED
#define MIXED 0
#endif
#ifndef TABLE
#define TABLE 0
#endif
#ifndef STEPS
#define STEPS 0
#endif
#ifndef BETWEEN
#define BETWEEN 0
#endif
#ifndef ROUNDED
#define ROUNDED 0
#endif

#if STACKED
#define AT(channel) (pixel + (channel) * pixels)
#else
#define AT(channel) (CHANNELS * pixel + (channel))
#endif

// min and clamp, which PoCL compiles to calls that no loop makes wide. What is no number is `low`.
INLINE int least(int a, int b)
{
    return a < b ? a : b;
}
INLINE real within(real x, real low, real high)
{
    const real raised = x > low ? x : low;
    return raised < high ? raised : high;
}

#define EACH_BLOCK(block) \
    const int first = get_global_id(0) * span, end = min(first + span, pixels); \
    for (int block = first; block < end; block += BLOCK)
#define EACH_PIXEL(pixel, block) \
    for (int pixel = block, stop = min(block + BLOCK, end); pixel < stop; ++pixel)

// With KEPT also direct light without a solve: light to add, and the light of the bounces of an
// earlier frame, less that of the background, which no gain scales.
kernel void frames_decode(
    int pixels,                     // of a frame
    int span,                       // pixels of a work-item
    real gain,                      // factor of the light
    real subtracts,                 // 1: the background counts
    global const CODE *codes,       // (pixels, COLOURS)
    global const real *table,       // light of each code; not read without TABLE
    global const real *background,  // like out; not read where it does not count
#if KEPT
    real share,                             // gain per that of the earlier frame
    global const real *kept,                // its bounces without those of the background, like out
    global const real *background_bounces,  // not read where the background does not count
    global real *direct,                    // like out
#endif
    global real *out)  // light to add
{
    real light[BLOCK];
    EACH_BLOCK(block)
        for (int c = 0; c < CHANNELS; ++c) {
            EACH_PIXEL(pixel, block) {
                const CODE code = codes[pixel * COLOURS + least(c, COLOURS - 1)];
#if TABLE
                light[pixel - block] = table[code];
#else
                light[pixel - block] = code;
#endif
            }
            EACH_PIXEL(pixel, block) {
                const real dark = subtracts != 0 ? background[AT(c)] : 0;
                const real added = gain * light[pixel - block] - dark;
                out[AT(c)] = added;
#if KEPT
                const real dark_bounces = subtracts != 0 ? background_bounces[AT(c)] : 0;
                direct[AT(c)] = added + (share * kept[AT(c)] - dark_bounces);
#endif
            }
        }
}

// Projector light of one channel, without bounds; 0 at masked pixels.
INLINE real projector_light(
    int pixel, int pixels, int channel, constant real *mixing, global const real *factors,
    global const real *direct)
{
    const real light = factors[AT(channel)] * direct[AT(channel)];
#if MIXED
    if (factors[AT(channel)] == 0)
        return 0;
    real sum = 0;
    for (int d = 0; d < CHANNELS; ++d)
        sum += mixing[CHANNELS * channel + d] * (factors[AT(d)] * direct[AT(d)]);
    return sum;
#else
    return light;
#endif
}

#define LIGHT_ARGUMENTS \
    int pixels, int span, real low, real high, constant real *mixing, \
        global const real *factors, global const real *direct
#define LIGHT(channel) projector_light(pixel, pixels, channel, mixing, factors, direct)

// x = scale * clip(p); exceeded[0] grows by the number of p that are outside by more than `slack`.
kernel void frames_clip(
    LIGHT_ARGUMENTS,
    real slack,                 // light beyond a bound by less counts as inside
    global const real *scales,  // unknowns per light, like direct
    global real *x,             // like direct
    global int *exceeded)       // [1]
{
    int outside = 0;
    EACH_BLOCK(block)
        for (int c = 0; c < CHANNELS; ++c)
            EACH_PIXEL(pixel, block) {
                const real light = LIGHT(c);
                const bool is_lit = factors[AT(c)] != 0;
                outside += is_lit && !(light >= low - slack && light <= high + slack);
                x[AT(c)] = is_lit ? scales[AT(c)] * within(light, low, high) : 0;
            }
    if (outside)
        atomic_add(exceeded, outside);
}

kernel void frames_encode(
    LIGHT_ARGUMENTS,
    int count,                      // thresholds of a channel, with an infinite one at the end
    int cells,                      // of equal width, in which light is looked up
    real cells_per_light,           // 1 / their width
    real first_light,               // where the first begins
    real code_step,                 // with BETWEEN, codes from one place to the next
    global const int *starts,       // (CHANNELS, cells), the place at which each begins
    global const real *thresholds,  // (CHANNELS, count), ascending
    global CODE *codes)             // (pixels, CHANNELS)
{
    real unmixed[BLOCK * CHANNELS];
    real lights[BLOCK];
    int in_cells[BLOCK];
    CODE found[BLOCK * CHANNELS];
    EACH_BLOCK(block) {
        // Once for all colours that are mixed of it.
        for (int c = 0; c < CHANNELS; ++c)
            EACH_PIXEL(pixel, block)
                unmixed[c * BLOCK + pixel - block] = factors[AT(c)] * direct[AT(c)];
        for (int c = 0; c < CHANNELS; ++c) {
            EACH_PIXEL(pixel, block) {
                const int i = pixel - block;
#if MIXED
                real free_light = 0;
                for (int d = 0; d < CHANNELS; ++d)
                    free_light += mixing[CHANNELS * c + d] * unmixed[d * BLOCK + i];
#else
                const real free_light = unmixed[c * BLOCK + i];
#endif
                const real inside = within(free_light, low, high);
                const real light = factors[AT(c)] != 0 ? inside : 0;
                const real at = (light - first_light) * cells_per_light;
                lights[pixel - block] = light;
                in_cells[pixel - block] = (int)within(at, (real)0, (real)(cells - 1));
            }
            global const real *list = thresholds + c * count;
            EACH_PIXEL(pixel, block) {
                const real light = lights[pixel - block];
#if STEPS
                int place = starts[c * cells + in_cells[pixel - block]];
                for (int more = 1 << (STEPS - 1); more > 0; more >>= 1)
                    place += light >= list[least(place + more, count) - 1] ? more : 0;
#if BETWEEN
                const int i = place < 1 ? 0 : least(place - 1, count - 3);
                const real width = list[i + 1] - list[i];
                const real share = width > 0 ? within((light - list[i]) / width, 0, 1) : 1.0f;
                const real code = (i + share) * code_step;
#if ROUNDED
                found[(pixel - block) * CHANNELS + c] = code + 0.5f;
#else
                found[(pixel - block) * CHANNELS + c] = code;
#endif
#else
                found[(pixel - block) * CHANNELS + c] = place;
#endif
#else
                found[(pixel - block) * CHANNELS + c] = light;
#endif
            }
        }
        const int begin = block * CHANNELS;
        for (int i = begin; i < min(block + BLOCK, end) * CHANNELS; ++i)
            codes[i] = found[i - begin];
    }
}

// Of the pixels of each work-item the largest share of the way to `high` that some light goes, both
// with `shift` added: what the background takes.
kernel void frames_peaks(
    LIGHT_ARGUMENTS,
    real shifts,               // 1: the shift counts
    global const real *shift,  // projector light like direct; not read where it does not count
    global real *peaks)        // one a work-item
{
    real peak = 0;
    EACH_BLOCK(block)
        for (int c = 0; c < CHANNELS; ++c)
            EACH_PIXEL(pixel, block) {
                const real added = shifts != 0 ? shift[AT(c)] : 0;
                if (high + added > 0)
                    peak = fmax(peak, (LIGHT(c) + added) / (high + added));
            }
    if (first < pixels)
        peaks[get_global_id(0)] = peak;
}
