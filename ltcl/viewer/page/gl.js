// SPDX-License-Identifier: BSD-3-Clause
// Draws linear light on canvases. One WebGL context serves them all: it draws at the size of the picture, one
// fragment a pixel, row 0 first, and the result is copied to the canvas, which CSS enlarges without smoothing.
// A browser takes contexts away, as when many notebooks are open: the next drawing makes another one.

const VERTEX = `#version 300 es
void main() { gl_Position = vec4(vec2(gl_VertexID & 1, gl_VertexID >> 1) * 4.0 - 1.0, 0.0, 1.0); }`;

// Variants are #define, sums among them: drawing in software pays for each branch, taken or not, and for loops.
const FRAGMENT = `precision highp float;
precision highp sampler2DArray;
uniform sampler2DArray light, deviation;
uniform float weights[LAYERS], others[LAYERS], spreads[LAYERS]; // right, left of the wipe; of deviation
uniform float wipe;
out vec4 colour;

vec3 stored(sampler2DArray pictures, ivec2 at, int k) {
  vec3 value = texelFetch(pictures, ivec3(at, k), 0).rgb;
  return GREY ? value.rrr : value;
}
vec3 square(vec3 value) { return value * value; }
vec3 heat(float t) { // fit of matplotlib's inferno by Matt Zucker (CC0)
  return clamp(vec3(0.0002, 0.0016, -0.0194) + t * (vec3(0.1065, 0.5639, 3.9327)
    + t * (vec3(11.6024, -3.9728, -15.9423) + t * (vec3(-41.7039, 17.4363, 44.3541)
    + t * (vec3(77.1629, -33.4023, -81.8073) + t * (vec3(-71.3194, 32.6260, 73.2095)
    + t * vec3(25.1311, -12.2426, -23.0703)))))), 0.0, 1.0);
}
// Four decades, one of them beyond white: a logarithm is asked for to see highlights, too.
float decades(float value) { return clamp(0.75 + 0.25 * log(max(value, 1e-9)) / log(10.0), 0.0, 1.0); }
vec3 encoded(vec3 linear) { // sRGB, to a tenth of a code: roots are far faster than powers where it is software
  vec3 root = sqrt(linear), curve = 0.83375 * root + 0.29811 * sqrt(root) - 0.05532 * linear - 0.0769;
  return mix(curve, 12.92 * linear, lessThan(linear, vec3(0.0031308)));
}
void main() {
  ivec2 at = ivec2(gl_FragCoord.xy);
  vec3 sum = SUM;
  if (isnan(sum.r)) sum = vec3(0.0); // masked
  float most = max(sum.r, max(sum.g, sum.b)), least = min(sum.r, min(sum.g, sum.b));
  float size = -least > most ? least : most; // with the sign of what is larger
#if MODE == 0 && LOGARITHMIC
  colour.rgb = vec3(decades(sum.r), decades(sum.g), decades(sum.b));
#elif MODE == 0
  colour.rgb = encoded(clamp(sum, 0.0, 1.0));
#elif MODE == 1
  colour.rgb = heat(LOGARITHMIC == 1 ? decades(most) : clamp(most, 0.0, 1.0));
#else
  float strength = LOGARITHMIC == 1 ? decades(abs(size)) : min(abs(size), 1.0);
  colour.rgb = encoded(strength * (size < 0.0 ? vec3(0.1, 0.45, 1.0) : vec3(1.0, 0.35, 0.1)));
#endif
#if UNCERTAIN
  vec3 variance = VARIANCE;
  float sigma = sqrt(max(variance.r, max(variance.g, variance.b)));
  colour.rgb = mix(colour.rgb, vec3(1.0, 0.2, 0.75), 0.9 * clamp(sigma / max(abs(size), 1e-4), 0.0, 1.0));
#endif
  colour.a = 1.0;
}`;

let surface = null, gl = null;
const programs = new Map();

// Whether there is a context that can draw.
export function ready() {
  if (gl && !gl.isContextLost()) return true;
  surface = document.createElement("canvas");
  gl = surface.getContext("webgl2", { alpha: false, antialias: false, depth: false });
  gl?.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
  programs.clear();
  return Boolean(gl);
}

// Give the context back, until something is drawn again.
export function release() {
  gl?.getExtension("WEBGL_lose_context")?.loseContext();
  gl = surface = null;
}

// Use the variant of the shader with these numbers for its names; returns the places of its uniforms.
function use(defines) {
  const head = Object.entries(defines).map(([name, value]) => `#define ${name} ${value}`).join("\n");
  if (!programs.has(head)) {
    const program = gl.createProgram(), variant = `#version 300 es\n${head}\n${FRAGMENT}`;
    for (const [type, source] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, variant]]) {
      const shader = gl.createShader(type);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    }
    gl.linkProgram(program);
    const names = ["deviation", "weights", "others", "spreads", "wipe"];
    const places = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(program, name)]));
    programs.set(head, { program, ...places });
  }
  gl.useProgram(programs.get(head).program);
  return programs.get(head);
}

// Pictures of one size as the layers of one texture.
export class Layers {
  set(pictures) {
    const { h, w, c } = pictures[0];
    Object.assign(this, { pictures, h, w, grey: c === 1 });
    if (ready()) this.upload();
  }

  // Bring the pictures to the context of now.
  upload() {
    const { pictures, h, w } = this, { c } = pictures[0], shape = [c === 1 ? gl.R32F : gl.RGB32F, w, h, pictures.length];
    if (this.owner !== gl || String(shape) !== String(this.shape)) {
      if (this.owner === gl) gl.deleteTexture(this.texture);
      this.texture = gl.createTexture();
      gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.texture);
      gl.texStorage3D(gl.TEXTURE_2D_ARRAY, 1, ...shape);
      for (const filter of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) {
        gl.texParameteri(gl.TEXTURE_2D_ARRAY, filter, gl.NEAREST);
      }
    }
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, this.texture);
    pictures.forEach(({ data }, k) => {
      gl.texSubImage3D(gl.TEXTURE_2D_ARRAY, 0, 0, 0, k, w, h, 1, c === 1 ? gl.RED : gl.RGB, gl.FLOAT, data);
    });
    Object.assign(this, { shape, owner: gl });
  }

  clear() {
    if (this.owner === gl) gl?.deleteTexture(this.texture);
    this.owner = null;
  }

  // The values of one pixel of the weighted sum.
  at(row, col, weights) {
    const each = this.pictures.map((picture, k) => picture.at(row, col).map((value) => weights[k] * value));
    return each.reduce((sum, values) => sum.map((value, channel) => value + values[channel]));
  }
}

// `look`: white (the value shown as white), logarithmic, mode (0 natural, 1 heat, 2 signed), weights; and
// optionally others and wipe (0 to 1: left of it the sum by `others`), deviation (Layers) to overlay.
export function draw(canvas, layers, look) {
  if (!ready()) return;
  for (const each of [layers, look.deviation]) if (each && each.owner !== gl) each.upload();
  const { h, w } = layers;
  if (surface.width < w || surface.height < h) {
    surface.width = Math.max(w, surface.width);
    surface.height = Math.max(h, surface.height);
  }
  if (canvas.width !== w || canvas.height !== h) [canvas.width, canvas.height] = [w, h];
  const LAYERS = layers.pictures.length;
  const total = (term) => Array.from({ length: LAYERS }, (_, k) => term.replaceAll("#", k)).join(" + ");
  const weight = look.others ? "(gl_FragCoord.x < wipe ? others[#] : weights[#])" : "weights[#]";
  const uniforms = use({
    LAYERS, GREY: layers.grey, MODE: look.mode, LOGARITHMIC: Number(look.logarithmic),
    SUM: total(`${weight} * stored(light, at, #)`), UNCERTAIN: Number(Boolean(look.deviation)),
    VARIANCE: total("square(spreads[#] * stored(deviation, at, #))"),
  });
  const scaled = (weights) => layers.pictures.map((_, k) => (weights[k] ?? 0) / look.white);
  gl.viewport(0, 0, w, h);
  gl.uniform1fv(uniforms.weights, scaled(look.weights));
  if (look.others) {
    gl.uniform1fv(uniforms.others, scaled(look.others));
    gl.uniform1f(uniforms.wipe, look.wipe * w);
  }
  if (look.deviation) {
    gl.uniform1fv(uniforms.spreads, scaled(look.weights));
    gl.uniform1i(uniforms.deviation, 1);
    gl.activeTexture(gl.TEXTURE1);
    gl.bindTexture(gl.TEXTURE_2D_ARRAY, look.deviation.texture);
    gl.activeTexture(gl.TEXTURE0);
  }
  gl.bindTexture(gl.TEXTURE_2D_ARRAY, layers.texture);
  gl.drawArrays(gl.TRIANGLES, 0, 3);
  const image = new ImageData(w, h);
  gl.readPixels(0, 0, w, h, gl.RGBA, gl.UNSIGNED_BYTE, image.data);
  canvas.getContext("2d").putImageData(image, 0, 0);
  canvas.dataset.frame = Number(canvas.dataset.frame ?? 0) + 1;
}
