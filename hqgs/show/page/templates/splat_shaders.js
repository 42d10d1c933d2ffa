// What splats.js draws with: the shaders, the order by depth, and the scene unpacked.
//
// Cameras are pinholes in the OpenCV frame (x right, y down, z forward), as in the rest of hqgs. Each Gaussian
// is a quad that covers its projected ellipse; a worker sorts them by depth, and they are blended back to front.
"use strict";

const SPLAT_WIDTH = 2048; // texels of a row of the data texture
const EPS2D = 0.3, NEAR = 0.01;

const VERTEX = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform usampler2D data;
uniform mat3 R;          // world to camera
uniform vec3 eye;
uniform vec4 pinhole;    // fx, fy, cx, cy in pixels
uniform vec2 size;       // pixels
uniform int degree, texels;
uniform vec2 colors;
uniform vec3 tops;
in uint place;
out vec2 offset;
out vec4 color;
flat out vec3 conic;

uvec4 texel(int k) {
  int i = int(place) * texels + k;
  return texelFetch(data, ivec2(i % ${SPLAT_WIDTH}, i / ${SPLAT_WIDTH}), 0);
}
uvec4 bands[3];
vec3 sh(int k) {         // the k-th of the higher harmonics
  vec3 found;
  for (int c = 0; c < 3; c++) {
    int byte = 3 * k + c;
    uint word = bands[byte / 16][(byte / 4) % 4];
    found[c] = float(int(word << (24 - 8 * (byte % 4))) >> 24) / 127.0;
  }
  return found;
}
vec3 harmonics(vec3 d) {
  for (int k = 0; k < 3; k++) bands[k] = k + 3 < texels ? texel(k + 3) : uvec4(0u);
  float x = d.x, y = d.y, z = d.z;
  vec3 sum = tops.x * 0.4886025119 * (z * sh(1) - y * sh(0) - x * sh(2));
  if (degree > 1) {
    sum += tops.y * (1.0925484306 * (x * y * sh(3) - y * z * sh(4) - x * z * sh(6))
      + 0.3153915653 * (3.0 * z * z - 1.0) * sh(5) + 0.5462742153 * (x * x - y * y) * sh(7));
  }
  if (degree > 2) {
    float w = 5.0 * z * z - 1.0;
    sum += tops.z * (0.5900435899 * (y * (y * y - 3.0 * x * x) * sh(8) + x * (3.0 * y * y - x * x) * sh(14))
      + 2.8906114426 * x * y * z * sh(9) + 1.4453057213 * z * (x * x - y * y) * sh(13)
      - 0.4570457995 * w * (y * sh(10) + x * sh(12)) + 0.3731763326 * z * (5.0 * z * z - 3.0) * sh(11));
  }
  return sum;
}
void main() {
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0); // outside: nothing is drawn
  uvec4 first = texel(0), second = texel(1), third = texel(2);
  vec3 mean = uintBitsToFloat(first.xyz);
  vec3 p = R * (mean - eye);
  if (p.z < ${NEAR}) return;
  vec4 a = uintBitsToFloat(second);
  vec2 b = uintBitsToFloat(third.xy);
  mat3 cov = mat3(a.x, a.y, a.z, a.y, a.w, b.x, a.z, b.x, b.y);
  vec2 tan2 = 0.5 * size / pinhole.xy;
  vec2 low = -(pinhole.zw / pinhole.xy + 0.3 * tan2), high = (size - pinhole.zw) / pinhole.xy + 0.3 * tan2;
  vec2 t = clamp(p.xy / p.z, low, high);
  mat3 J = mat3(pinhole.x / p.z, 0.0, 0.0, 0.0, pinhole.y / p.z, 0.0,
                -pinhole.x * t.x / p.z, -pinhole.y * t.y / p.z, 0.0);
  mat3 T = J * R, c = T * cov * transpose(T);
  float xx = c[0][0] + ${EPS2D}, yy = c[1][1] + ${EPS2D}, xy = c[0][1];
  float det = xx * yy - xy * xy;
  uint word = first.w;
  float opacity = float(word >> 24) / 255.0;
  if (!(det > 0.0) || opacity < 1.0 / 255.0) return;
  vec2 centre = pinhole.xy * p.xy / p.z + pinhole.zw;
  // The ellipse within which alpha is at least 1/255, along its axes.
  float reach = sqrt(2.0 * log(255.0 * opacity)), mid = 0.5 * (xx + yy);
  float gap = sqrt(max(mid * mid - det, 0.0)), long2 = mid + gap, short2 = max(mid - gap, 1e-6);
  vec2 axis = abs(xy) > 1e-9 ? normalize(vec2(xy, long2 - xx)) : (xx >= yy ? vec2(1, 0) : vec2(0, 1));
  vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2.0 - 1.0;
  offset = reach * (corner.x * sqrt(long2) * axis + corner.y * sqrt(short2) * vec2(-axis.y, axis.x));
  vec2 pixel = centre + offset;
  vec2 far = reach * sqrt(vec2(xx, yy));
  if (any(lessThan(centre + far, vec2(0))) || any(greaterThan(centre - far, size))) return;
  conic = vec3(yy, -xy, xx) / det;
  vec3 rgb = vec3(word & 255u, word >> 8 & 255u, word >> 16 & 255u) / 255.0;
  rgb = colors.x + (colors.y - colors.x) * rgb;
  if (degree > 0) rgb += harmonics(normalize(mean - eye));
  color = vec4(max(rgb, 0.0), opacity);
  gl_Position = vec4(2.0 * pixel.x / size.x - 1.0, 1.0 - 2.0 * pixel.y / size.y, 0.0, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision highp float;
in vec2 offset;
in vec4 color;
flat in vec3 conic;
out vec4 shown;
void main() {
  float sigma = 0.5 * (conic.x * offset.x * offset.x + conic.z * offset.y * offset.y) + conic.y * offset.x * offset.y;
  float alpha = min(0.99, color.a * exp(-sigma));
  if (alpha < 1.0 / 255.0) discard;
  shown = vec4(alpha * color.rgb, alpha);
}`;

// Runs in the worker: the places of the Gaussians from far to near, by counting depths in 65536 steps.
function splatOrder(means, axis) {
  const count = means.length / 3, depths = new Float32Array(count), order = new Uint32Array(count);
  let low = Infinity, high = -Infinity;
  for (let i = 0; i < count; i++) {
    const d = means[3 * i] * axis[0] + means[3 * i + 1] * axis[1] + means[3 * i + 2] * axis[2];
    depths[i] = d;
    if (d < low) low = d;
    if (d > high) high = d;
  }
  // Depths far behind all others must not take the steps from the rest: cubes of the distance would; ranks do.
  const sample = [];
  for (let i = 0; i < count; i += Math.max(1, count >> 10)) sample.push(depths[i]);
  sample.sort((a, b) => a - b);
  const from = sample[sample.length >> 6], to = sample[sample.length - 1 - (sample.length >> 6)];
  const starts = new Uint32Array(65537), keys = new Uint16Array(count);
  const step = 64000 / Math.max(to - from, 1e-20), below = 700 / Math.max(from - low, 1e-20), above = 700 / Math.max(high - to, 1e-20);
  for (let i = 0; i < count; i++) {
    const d = depths[i];
    const k = d < from ? (d - low) * below : d > to ? 64760 + (d - to) * above : 710 + (d - from) * step;
    keys[i] = 65535 - k;
    starts[keys[i] + 1]++;
  }
  for (let k = 0; k < 65536; k++) starts[k + 1] += starts[k];
  for (let i = 0; i < count; i++) order[starts[keys[i]]++] = i;
  return order;
}

async function unpackSplats(text) {
  const raw = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([raw]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
