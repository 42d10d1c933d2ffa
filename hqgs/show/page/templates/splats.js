// A viewer of Gaussian splats in WebGL 2: `new SplatViewer(canvas, head, bytes, views, up)`, after
// splat_shaders.js.
class SplatViewer {
  constructor(canvas, head, bytes, views, up) {
    this.canvas = canvas;
    this.head = head;
    this.views = views;
    this.up = up;
    this.frames = 0;
    this.scale = 1;
    this.keys = new Set();
    this.decode(bytes);
    this.startGl();
    this.startSorting();
    this.listen();
    this.go(0);
  }

  decode(bytes) {
    const { count: n, degree, sets, low, high, scales, tops } = this.head;
    const rest = 3 * ((degree + 1) ** 2 - 1);
    let at = 0;
    const take = (Kind, many) => {
      const part = new Kind(bytes.buffer.slice(at, at + many * Kind.BYTES_PER_ELEMENT));
      at += many * Kind.BYTES_PER_ELEMENT;
      return part;
    };
    const fine = take(Uint8Array, 3 * n), coarse = take(Uint8Array, 3 * n), logs = take(Uint8Array, 3 * n), quats = take(Int8Array, 4 * n);
    const alphas = take(Uint8Array, n), rgb = take(Uint8Array, 3 * n);
    const labels = take(Uint16Array, n), sh = take(Int8Array, rest * sets);
    this.texels = 3 + Math.ceil(rest / 16);
    this.rows = Math.max(1, Math.ceil((n * this.texels) / SPLAT_WIDTH));
    const words = new Uint32Array(SPLAT_WIDTH * this.rows * 4), floats = new Float32Array(words.buffer);
    const signed = new Int8Array(words.buffer);
    this.means = new Float32Array(3 * n);
    const s = new Float64Array(3), range = (scales[1] - scales[0]) / 255;
    for (let i = 0; i < n; i++) {
      const w = i * this.texels * 4;
      for (let k = 0; k < 3; k++) {
        const log = low[k] + ((high[k] - low[k]) * (fine[k * n + i] + 256 * coarse[k * n + i])) / 65535;
        this.means[3 * i + k] = floats[w + k] = Math.sign(log) * Math.expm1(Math.abs(log));
        s[k] = Math.exp(2 * (scales[0] + range * logs[k * n + i]));
      }
      words[w + 3] = (rgb[i] | (rgb[n + i] << 8) | (rgb[2 * n + i] << 16) | (alphas[i] << 24)) >>> 0;
      let q = [quats[i], quats[n + i], quats[2 * n + i], quats[3 * n + i]];
      const norm = Math.hypot(...q) || 1;
      const [r, x, y, z] = q.map((v) => v / norm);
      const M = [
        1 - 2 * (y * y + z * z), 2 * (x * y - r * z), 2 * (x * z + r * y),
        2 * (x * y + r * z), 1 - 2 * (x * x + z * z), 2 * (y * z - r * x),
        2 * (x * z - r * y), 2 * (y * z + r * x), 1 - 2 * (x * x + y * y),
      ];
      let place = w + 4;
      for (let a = 0; a < 3; a++)
        for (let c = a; c < 3; c++)
          floats[place++] = M[3 * a] * M[3 * c] * s[0] + M[3 * a + 1] * M[3 * c + 1] * s[1] + M[3 * a + 2] * M[3 * c + 2] * s[2];
      for (let k = 0; k < rest; k++) signed[4 * (w + 12) + k] = sh[k * sets + labels[i]];
    }
    this.words = words;
    this.tops = [...tops, 0, 0, 0].slice(0, 3);
  }

  startGl() {
    const gl = this.canvas.getContext("webgl2", { antialias: false, alpha: false, preserveDrawingBuffer: true });
    if (!gl) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    const program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "place");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    this.at = (name) => gl.getUniformLocation(program, name);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
    if (this.rows > gl.getParameter(gl.MAX_TEXTURE_SIZE)) throw new Error("the scene is too large for this graphics card");
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, SPLAT_WIDTH, this.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, this.words);
    this.words = null;
    gl.uniform1i(this.at("data"), 0);
    gl.uniform1i(this.at("degree"), this.head.degree);
    gl.uniform1i(this.at("texels"), this.texels);
    gl.uniform2fv(this.at("colors"), this.head.colors);
    gl.uniform3fv(this.at("tops"), this.tops);
    this.orderBuffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, this.orderBuffer);
    gl.enableVertexAttribArray(0);
    gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(0, 1);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.clearColor(...this.head.background, 1);
  }

  startSorting() {
    this.sorted = 0;
    const take = (order) => {
      const gl = this.gl;
      gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
      this.sorted = order.length;
      this.sorting = false;
      this.dirty = true;
    };
    try {
      const text = `${splatOrder}; let means; onmessage = (e) => { if (e.data.means) means = e.data.means; else { const o = splatOrder(means, e.data.axis); postMessage(o, [o.buffer]); } };`;
      this.worker = new Worker(URL.createObjectURL(new Blob([text], { type: "text/javascript" })));
      this.worker.onmessage = (e) => take(e.data);
      this.worker.postMessage({ means: this.means });
      this.sort = (axis) => this.worker.postMessage({ axis });
    } catch (error) { // a browser that lets no worker start from a file
      this.sort = (axis) => take(splatOrder(this.means, axis));
    }
  }

  // The pose: `R` has the camera's axes in the world as rows, `distance` is that of the point it turns around.
  set(view) {
    this.R = view.R.map((row) => [...row]);
    this.eye = [...view.eye];
    this.fy = view.fy; // focal length in heights of the picture
    this.ratio = view.ratio ?? 1; // fx / fy
    this.middle = view.middle ?? [0.5, 0.5]; // principal point in sides of the picture
    this.distance = view.distance;
    this.dirty = true;
  }

  go(number) {
    this.number = (number + this.views.length) % this.views.length;
    this.set(this.views[this.number]);
    if (this.ongo) this.ongo(this.number);
  }

  turn(dx, dy, around) {
    const ahead = this.distance, forward = this.R[2];
    const pivot = this.eye.map((v, k) => v + ahead * forward[k]);
    const spin = (axis, angle) => {
      const [x, y, z] = axis, c = Math.cos(angle), s = Math.sin(angle), t = 1 - c;
      const M = [[t * x * x + c, t * x * y - s * z, t * x * z + s * y], [t * x * y + s * z, t * y * y + c, t * y * z - s * x], [t * x * z - s * y, t * y * z + s * x, t * z * z + c]];
      this.R = this.R.map((row) => M.map((m) => m[0] * row[0] + m[1] * row[1] + m[2] * row[2]));
    };
    const side = around ? 1 : -0.6;
    spin(this.up, -side * dx);
    const steep = this.R[2].reduce((sum, v, k) => sum + v * this.up[k], 0);
    if ((steep > -0.97 || side * dy < 0) && (steep < 0.97 || side * dy > 0)) spin(this.R[0], -side * -dy);
    if (around) this.eye = pivot.map((v, k) => v - ahead * this.R[2][k]);
    this.square();
  }

  square() { // rounding must not bend the axes
    const norm = (v) => { const l = Math.hypot(...v); return v.map((x) => x / l); };
    const [r, , f] = this.R, z = norm(f), dot = r[0] * z[0] + r[1] * z[1] + r[2] * z[2];
    const x = norm(r.map((v, k) => v - dot * z[k]));
    this.R = [x, [z[1] * x[2] - z[2] * x[1], z[2] * x[0] - z[0] * x[2], z[0] * x[1] - z[1] * x[0]], z];
    this.dirty = true;
  }

  move(right, down, forward) {
    this.eye = this.eye.map((v, k) => v + right * this.R[0][k] + down * this.R[1][k] + forward * this.R[2][k]);
    this.dirty = true;
  }

  listen() {
    const canvas = this.canvas, fingers = new Map();
    canvas.style.touchAction = "none";
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => {
      canvas.setPointerCapture(e.pointerId);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
      canvas.focus({ preventScroll: true });
    });
    for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, (e) => fingers.delete(e.pointerId));
    canvas.addEventListener("pointermove", (e) => {
      const before = fingers.get(e.pointerId);
      if (!before) return;
      const per = 1 / canvas.clientHeight, dx = (e.clientX - before[0]) * per, dy = (e.clientY - before[1]) * per;
      if (fingers.size === 2) {
        const other = [...fingers].find(([id]) => id !== e.pointerId)[1];
        const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]);
        this.zoom((apart(before) - apart([e.clientX, e.clientY])) * per * 3);
        this.move((-dx * this.distance) / (2 * this.fy), (-dy * this.distance) / (2 * this.fy), 0);
      } else if (e.buttons & 2 || e.shiftKey) {
        this.move((-dx * this.distance) / this.fy, (-dy * this.distance) / this.fy, 0);
      } else this.turn(2.5 * dx, 2.5 * dy, !e.altKey);
      fingers.set(e.pointerId, [e.clientX, e.clientY]);
    });
    canvas.addEventListener("wheel", (e) => {
      e.preventDefault();
      this.zoom(Math.sign(e.deltaY) * Math.min(Math.abs(e.deltaY), 100) * 0.0015);
    }, { passive: false });
    const key = (e) => e.key.length === 1 ? e.key.toLowerCase() : e.key;  // Shift or Caps Lock may change meanwhile
    canvas.addEventListener("keydown", (e) => {
      if (e.ctrlKey || e.metaKey || !("wasdqe".includes(key(e)) || key(e).startsWith("Arrow"))) return;
      this.keys.add(key(e)); e.preventDefault(); this.dirty = true;
    });
    canvas.addEventListener("keyup", (e) => this.keys.delete(key(e)));
    canvas.addEventListener("blur", () => this.keys.clear());
    let last = 0, moved = 0, coarse = 1;
    const tick = (now) => {
      const seconds = Math.min((now - last) / 1000, 0.1);
      last = now;
      this.walk(seconds);
      // Coarser while it moves, as far as this graphics card needs that; sharp when it rests.
      if (this.dirty) {
        if (now - moved < 1000) {
          if (now - moved > 60) coarse = Math.max(0.25, 0.8 * coarse);
          else if (now - moved < 20) coarse = Math.min(1, 1.1 * coarse);
        }
        this.scale = now - moved < 1000 ? coarse : 1;
        moved = now;
      } else if (this.scale < 1 && now - moved > 200) {
        this.scale = 1;
        this.dirty = true;
      }
      this.draw();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  zoom(amount) {
    const old = this.distance;
    this.distance *= Math.exp(amount);
    this.move(0, 0, old - this.distance);
  }

  walk(seconds) {
    if (!this.keys.size) return;
    const on = (a, b) => (this.keys.has(a) || this.keys.has(b) ? 1 : 0), way = seconds * 0.7 * this.distance;
    this.move(way * (on("d", "") - on("a", "")), way * (on("q", "") - on("e", "")), way * (on("w", "ArrowUp") - on("s", "ArrowDown")));
    const turn = seconds * (on("ArrowLeft", "") - on("ArrowRight", ""));
    if (turn) this.turn(2 * turn, 0, false);
  }

  draw() {
    const { canvas, gl } = this, ratio = Math.min(window.devicePixelRatio || 1, 2) * this.scale;
    const width = this.size ? this.size[0] : Math.max(1, Math.round(canvas.clientWidth * ratio));
    const height = this.size ? this.size[1] : Math.max(1, Math.round(canvas.clientHeight * ratio));
    if (canvas.width !== width || canvas.height !== height) { canvas.width = width; canvas.height = height; this.dirty = true; }
    if (!this.dirty) return;
    if (!this.sorting && String(this.R[2]) !== this.sortedFor) {
      this.sorting = true;
      this.sortedFor = String(this.R[2]);
      this.sort(this.R[2]);
    }
    const turned = this.sorting && String(this.R[2]) !== this.sortedFor;
    this.dirty = turned; // once more when the worker is free
    gl.viewport(0, 0, width, height);
    gl.clear(gl.COLOR_BUFFER_BIT);
    const R = this.R, fy = this.fy * height;
    gl.uniformMatrix3fv(this.at("R"), false, [R[0][0], R[1][0], R[2][0], R[0][1], R[1][1], R[2][1], R[0][2], R[1][2], R[2][2]]);
    gl.uniform3fv(this.at("eye"), this.eye);
    gl.uniform4f(this.at("pinhole"), fy * this.ratio, fy, this.middle[0] * width, this.middle[1] * height);
    gl.uniform2f(this.at("size"), width, height);
    if (this.sorted) gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.sorted);
    this.frames++;
  }

  get settled() { return this.sorted > 0 && !this.sorting && !this.dirty && this.scale === 1; }
}
