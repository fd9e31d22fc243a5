// 3D Gaussian splats in the canvas of a View (walk.js), by WebGL 2 beside three.js. They look as in the project's own
// renderer (texturing/splats): same projection, kernel, cut-off and low-pass filter, blended nearest first, before a
// background at infinity. three.js' own object ends splats at two standard deviations, and blends otherwise.
"use strict";

(() => {
  const { bytes } = window.scan2sim;
  const WORDS = 8; // 32-bit words of a splat: pipeline/io/worlds/packed_splats.py
  const SPLATS_IN_ROW = 1024; // of the texture, two texels each
  const SMALL_DEVICE = (navigator.deviceMemory ?? Infinity) <= 4 || matchMedia("(pointer: coarse)").matches; // GB of memory
  const MAX_SPLATS = SMALL_DEVICE ? 1e6 : 3e6; // of all loaded tiles
  const MIN_TEXTURE_SIZE = 2048; // texels in each direction that every WebGL 2 has
  const GREY = new Uint8Array([128, 128, 128, 255]); // background that can't be decoded
  const BACKGROUNDS = 3; // that are drawn at once, those with the largest shares (also in OVER)
  const MAX_PIXELS = 2.1e6; // of the image in which splats are blended; larger canvases show it enlarged

  const PROJECT = `#version 300 es
    precision highp float;
    precision highp int;
    precision highp usampler2D;
    uniform usampler2D splats;
    uniform mat3 rotation; // from the world to the camera: x right, y down, z ahead
    uniform vec3 eye;
    uniform vec2 focal, size; // pixels
    uniform float max_colour; // of the largest level; 1 is white
    layout(location = 0) in uint index;
    out vec2 from_centre; // 1 where alpha is MIN_ALPHA
    flat out vec4 colour; // with opacity
    flat out float farthest; // squared standard deviations at the edge

    const float NEAR = .2; // metres
    const float MIN_ALPHA = 1. / 255.;
    const float LOW_PASS = .3; // variance in square pixels
    const float MARGIN = .15; // of the image on either side, at which the projection is linearized at most

    mat3 axes(vec4 q) { // rotation matrix of a quaternion w x y z
      float w = q.x, x = q.y, y = q.z, z = q.w;
      return mat3(
        1. - 2. * (y * y + z * z), 2. * (x * y + w * z), 2. * (x * z - w * y),
        2. * (x * y - w * z), 1. - 2. * (x * x + z * z), 2. * (y * z + w * x),
        2. * (x * z + w * y), 2. * (y * z - w * x), 1. - 2. * (x * x + y * y)
      );
    }

    void main() {
      gl_Position = vec4(0., 0., 2., 1.); // outside, unless it is seen
      ivec2 texel = ivec2(2 * (int(index) % ${SPLATS_IN_ROW}), int(index) / ${SPLATS_IN_ROW});
      uvec4 first = texelFetch(splats, texel, 0), second = texelFetch(splats, texel + ivec2(1, 0), 0);
      vec3 centre = rotation * (uintBitsToFloat(first.xyz) - eye);
      float opacity = float(second.y >> 16) / 65535.;
      if (centre.z < NEAR || opacity <= MIN_ALPHA) return;
      colour = vec4(vec3(uvec3(first.w, first.w >> 10, first.w >> 20) & 1023u) * (max_colour / 1023.), opacity);
      vec3 scale = vec3(unpackHalf2x16(second.x), unpackHalf2x16(second.y & 65535u).x);
      mat3 turned = rotation * axes(normalize(vec4(unpackSnorm2x16(second.z), unpackSnorm2x16(second.w))));

      vec2 middle = (size - 1.) / 2.;
      vec2 slope = clamp(centre.xy / centre.z, -(middle + MARGIN * size) / focal, (size - middle + MARGIN * size) / focal);
      float a = LOW_PASS, b = 0., c = LOW_PASS; // covariance in the image
      for (int k = 0; k < 3; k++) {
        vec2 m = scale[k] * focal / centre.z * (turned[k].xy - slope * turned[k].z);
        a += m.x * m.x;
        b += m.x * m.y;
        c += m.y * m.y;
      }
      float mean = (a + c) / 2., half_difference = (a - c) / 2., radius = length(vec2(half_difference, b));
      vec2 major = half_difference > 0. ? vec2(radius + half_difference, b) : vec2(b, radius - half_difference);
      major = radius > 0. ? normalize(major) : vec2(1., 0.);
      farthest = 2. * log(opacity / MIN_ALPHA);
      from_centre = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2. - 1.;
      vec2 extent = from_centre * sqrt(farthest * vec2(mean + radius, max(mean - radius, LOW_PASS)));
      vec2 pixel = focal * centre.xy / centre.z + middle + mat2(major, vec2(-major.y, major.x)) * extent;
      gl_Position = vec4((2. * (pixel + .5) / size - 1.) * vec2(1., -1.), 0., 1.);
    }`;

  const KERNEL = `#version 300 es
    precision highp float;
    in vec2 from_centre;
    flat in vec4 colour;
    flat in float farthest;
    out vec4 drawn;

    void main() {
      float square = dot(from_centre, from_centre);
      if (square > 1.) discard;
      float alpha = min(colour.a * exp(-.5 * farthest * square), .99);
      drawn = vec4(alpha * colour.rgb, alpha);
    }`;

  const COVER = `#version 300 es
    uniform mat3 towards; // from the camera to the world
    uniform vec2 slope; // of the rays at the right and lower edge
    out vec2 at;
    out vec3 ray;

    void main() {
      vec2 corner = vec2(gl_VertexID & 1, gl_VertexID >> 1) * 2. - 1.;
      at = corner / 2. + .5;
      ray = towards * vec3(corner * vec2(1., -1.) * slope, 1.);
      gl_Position = vec4(corner, 0., 1.);
    }`;

  const OVER = `#version 300 es
    precision highp float;
    precision highp sampler2D;
    uniform sampler2D image, backgrounds[3]; // transmittance is the image's alpha
    uniform float weights[3]; // share of each background, times the colour of its level 1
    in vec2 at;
    in vec3 ray;
    out vec4 drawn;

    const float PI = 3.14159265358979;

    void main() {
      vec4 splats = texture(image, at);
      vec2 direction = vec2(atan(ray.y, ray.x) / (2. * PI) + .5, .5 - atan(ray.z, length(ray.xy)) / PI);
      vec3 behind = weights[0] * texture(backgrounds[0], direction).rgb + weights[1] * texture(backgrounds[1], direction).rgb
        + weights[2] * texture(backgrounds[2], direction).rgb;
      drawn = vec4(splats.rgb + splats.a * behind, 1.);
    }`;

  // A worker. It receives tiles: name, positions (x, y, z of each splat) and rows of the texture; names of tiles to drop;
  // and rows [x, y, z, 1] of depth, to which it returns the splats' indices in the texture, sorted by depth.
  function sorter(splats_in_row) {
    const LEVELS = 65536; // 4096 an octave, from 1/8 m
    const FIRST = (127 - 3) * 4096; // level of 1/8 m: a float's upper bits are a logarithm
    const tiles = new Map(), depth = new Float32Array(1), bits = new Int32Array(depth.buffer);
    let levels = new Uint16Array(0); // of all splats, tile by tile

    function sort([a, b, c, d]) {
      const next = new Uint32Array(LEVELS + 1), order = new Uint32Array(levels.length);
      let at = 0;
      for (const { xyz } of tiles.values()) {
        for (let i = 0; i < xyz.length; i += 3) {
          depth[0] = a * xyz[i] + b * xyz[i + 1] + c * xyz[i + 2] + d;
          const level = Math.min(LEVELS - 1, Math.max(0, (bits[0] >> 11) - FIRST));
          levels[at++] = level;
          next[level + 1]++;
        }
      }
      for (let k = 0; k < LEVELS; k++) next[k + 1] += next[k];
      at = 0;
      for (const { xyz, rows } of tiles.values()) {
        for (let i = 0; i < xyz.length / 3; i++) {
          order[next[levels[at++]]++] = rows[Math.floor(i / splats_in_row)] * splats_in_row + (i % splats_in_row);
        }
      }
      return order;
    }

    self.onmessage = ({ data }) => {
      if (data.row) {
        const order = sort(data.row);
        self.postMessage({ order, version: data.version }, [order.buffer]);
        return;
      }
      if (data.xyz) tiles.set(data.name, data);
      else tiles.delete(data.name);
      levels = new Uint16Array([...tiles.values()].reduce((sum, { xyz }) => sum + xyz.length / 3, 0));
    };
  }

  function program(gl, ...sources) {
    const made = gl.createProgram();
    sources.forEach((source, k) => {
      const shader = gl.createShader(k ? gl.FRAGMENT_SHADER : gl.VERTEX_SHADER);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(made, shader);
    });
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS) && !gl.isContextLost()) {
      throw new Error(`splats can't be drawn: ${gl.getAttachedShaders(made).map((shader) => gl.getShaderInfoLog(shader)).join("")}`);
    }
    return made;
  }

  function texture(gl, filter, wrap) {
    const made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    for (const kind of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, kind, filter);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, wrap);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_T, gl.CLAMP_TO_EDGE);
    return made;
  }

  // A texture for a background; the background that it holds, and the one that is to be loaded; its share of what is drawn.
  function slot(gl) {
    const made = { texture: texture(gl, gl.LINEAR, gl.REPEAT), source: null, wanted: null, share: 0, scale: 1 };
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, GREY);
    return made;
  }

  // Decode an image without colour management, or as the browser can; null if it can't.
  async function decode(blob) {
    for (const options of [[{ colorSpaceConversion: "none", premultiplyAlpha: "none" }], []]) {
      try {
        return await createImageBitmap(blob, ...options);
      } catch (error) {
        console.warn(`background of the splats: ${error.message}`);
      }
    }
    return null;
  }

  // A camera of three.js: rotation (rows) from the world to x right, y down, z ahead; eye; slopes of the image's edges.
  function seen(camera) {
    camera.updateMatrixWorld();
    const m = camera.matrixWorld.elements, p = camera.projectionMatrix.elements;
    const rows = [[m[0], m[1], m[2]], [-m[4], -m[5], -m[6]], [-m[8], -m[9], -m[10]]];
    return { rows, eye: [m[12], m[13], m[14]], slope: [1 / p[0], 1 / p[5]] };
  }

  // All splats that are loaded, of one tile or several, in rows of a texture. Sorting takes a while: an order, and the rows
  // that it refers to, are used until the next one is there.
  class Splats {
    // Number of rows of the texture that a tile needs.
    static rows_of(splats) {
      return Math.ceil(splats / SPLATS_IN_ROW);
    }

    // renderer: of three.js; counts: numbers of splats of all tiles; changed: called when there is something new to draw
    constructor(renderer, counts, changed) {
      this.renderer = renderer;
      this.gl = renderer.getContext();
      this.changed = changed;
      const all = counts.reduce((sum, count) => sum + Splats.rows_of(count), 0);
      this.rows = Math.min(all, Splats.rows_of(MAX_SPLATS), this.gl.getParameter(this.gl.MAX_TEXTURE_SIZE) || MIN_TEXTURE_SIZE);
      this.free = Array.from({ length: this.rows }, (_, k) => this.rows - 1 - k); // rows that no tile has
      this.tiles = new Map(); // name to the splats' words, their rows and the background
      this.version = 0; // of the tiles
      this.pending = new Set(); // names of the tiles to upload with the next order: until then, their rows may be in use
      this.shown = new Set(); // names of the tiles in the order that is drawn
      this.row = []; // of depth, as drawn last
      this.sorted = { version: 0, row: [] }; // of the last request
      this.waiting = false; // for an order
      this.slots = []; // textures of backgrounds, of which some are drawn
      this.max_colour = 1;
      this.count = 0; // of the splats that are drawn
      this.size = [0, 0]; // of the image in which they are blended
      const url = URL.createObjectURL(new Blob([`(${sorter})(${SPLATS_IN_ROW})`]));
      this.worker = new Worker(url);
      this.worker.addEventListener("message", () => URL.revokeObjectURL(url), { once: true });
      this.worker.addEventListener("message", ({ data }) => this.take_order(data));
      this.use_webgl((gl) => this.prepare(gl));
      renderer.domElement.addEventListener("webglcontextrestored", () => this.restore()); // phones lose it in the background
    }

    // Make again what was lost with the WebGL context.
    restore() {
      this.shown = new Set();
      this.pending = new Set(this.tiles.keys());
      this.size = [0, 0];
      this.use_webgl((gl) => this.prepare(gl));
      this.version++;
      this.changed();
    }

    // Use WebGL: three.js, which remembers the state, finds and leaves the default state.
    use_webgl(work) {
      this.renderer.resetState();
      work(this.gl);
      this.gl.bindVertexArray(null);
      this.renderer.resetState();
    }

    prepare(gl) {
      const half = gl.getExtension("EXT_color_buffer_half_float") ?? gl.getExtension("EXT_color_buffer_float");
      this.format = half ? [gl.RGBA16F, gl.HALF_FLOAT] : [gl.RGBA8, gl.UNSIGNED_BYTE];
      this.blending = program(gl, PROJECT, KERNEL);
      this.covering = program(gl, COVER, OVER);
      this.texture = texture(gl, gl.NEAREST, gl.CLAMP_TO_EDGE);
      gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA32UI, 2 * SPLATS_IN_ROW, this.rows);
      this.slots = Array.from({ length: BACKGROUNDS }, () => slot(gl));
      this.image = texture(gl, gl.LINEAR, gl.CLAMP_TO_EDGE);
      this.frame = gl.createFramebuffer();
      this.order = gl.createBuffer();
      this.vertices = gl.createVertexArray();
      gl.bindVertexArray(this.vertices);
      gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
      gl.enableVertexAttribArray(0);
      gl.vertexAttribIPointer(0, 1, gl.UNSIGNED_INT, 0, 0);
      gl.vertexAttribDivisor(0, 1);
    }

    // Add a tile: what its script passes (pipeline/io/worlds/packed_splats.py), and its offset in metres. It is drawn as soon
    // as it is sorted.
    put(name, [packed, jpeg, max_colour, background_scale], offset = [0, 0, 0]) {
      this.drop(name);
      const { buffer } = bytes(packed), words = new Uint32Array(buffer), floats = new Float32Array(buffer);
      const count = words.length / WORDS, needed = Splats.rows_of(count), xyz = new Float32Array(3 * count);
      if (needed > this.free.length) throw new Error(`${count} splats are too many for this device`);
      for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) xyz[3 * i + k] = floats[WORDS * i + k] += offset[k];
      const rows = Array.from({ length: needed }, () => this.free.pop());
      this.tiles.set(name, { words, rows, background: { blob: new Blob([bytes(jpeg)], { type: "image/jpeg" }), scale: background_scale } });
      this.max_colour = max_colour; // the same of all tiles
      this.pending.add(name);
      this.worker.postMessage({ name, xyz, rows }, [xyz.buffer]);
      this.version++;
      this.changed();
    }

    // Remove a tile, if it was added.
    drop(name) {
      const tile = this.tiles.get(name);
      if (!tile) return;
      this.tiles.delete(name);
      this.pending.delete(name);
      this.free.push(...tile.rows);
      this.worker.postMessage({ name });
      this.version++;
      this.changed();
    }

    // Whether a tile was added, and whether it is drawn already.
    has(name) {
      return this.tiles.has(name);
    }

    shows(name) {
      return this.shown.has(name);
    }

    // Whether the order of the last row of depth and the newest tiles was requested.
    get requested() {
      return this.sorted.version === this.version && this.row.every((value, k) => value === this.sorted.row[k]);
    }

    // Whether the last image is final: nothing is loaded or sorted any more.
    get settled() {
      return !this.waiting && this.requested && this.slots.some(({ source }) => source) && this.slots.every(({ source, wanted }) => source === wanted);
    }

    // Have the splats sorted by a row of depth, unless they are, or are being sorted.
    sort(row) {
      this.row = row;
      if (this.waiting || this.requested || !this.version) return;
      this.waiting = true;
      this.sorted = { version: this.version, row };
      this.worker.postMessage(this.sorted);
    }

    // Copy a tile's splats into its rows of the texture.
    upload(gl, { words, rows }) {
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      rows.forEach((row, k) => {
        const first = k * SPLATS_IN_ROW * WORDS, width = Math.min(2 * SPLATS_IN_ROW, (words.length - first) / 4);
        gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, row, width, 1, gl.RGBA_INTEGER, gl.UNSIGNED_INT, words, first);
      });
    }

    // Take an order from the worker, and upload the tiles that are new in it.
    take_order({ order, version }) {
      this.waiting = false;
      if (version === this.version) {
        this.use_webgl((gl) => {
          for (const name of this.pending) this.upload(gl, this.tiles.get(name));
          gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
          gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
        });
        this.count = order.length;
        this.shown = new Set(this.tiles.keys());
        this.pending.clear();
      }
      this.changed();
    }

    // Load a background into a slot, unless it is there or being loaded; grey if it can't be decoded.
    async load_background(slot, background) {
      if (background === slot.wanted) return;
      slot.wanted = background;
      const image = await decode(background.blob);
      if (background === slot.wanted && this.slots.includes(slot)) {
        this.use_webgl((gl) => {
          gl.bindTexture(gl.TEXTURE_2D, slot.texture);
          if (image) gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
          else gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, 1, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, GREY);
        });
        slot.scale = image ? background.scale : 1;
        slot.source = background;
        this.changed();
      }
      image?.close();
    }

    // Distribute the backgrounds of tiles [name, share] to the slots; what a slot holds is drawn until the new one is loaded.
    arrange(behind) {
      const shares = behind.map(([name, share]) => [this.tiles.get(name)?.background, share]).filter(([background]) => background);
      const wanted = new Map(shares.sort((a, b) => b[1] - a[1]).slice(0, BACKGROUNDS));
      if (!wanted.size) return;
      const free = this.slots.filter((one) => !wanted.has(one.wanted)).sort((a, b) => !!b.source - !!a.source);
      for (const one of free) one.share = 0;
      for (const [background, share] of wanted) {
        const slot = this.slots.find((one) => one.wanted === background) ?? free.shift();
        slot.share = share;
        this.load_background(slot, background);
      }
    }

    // Fill the canvas with what a camera sees, before the backgrounds of tiles [name, share]; false: nothing can be drawn yet.
    draw(camera, behind) {
      const { rows, eye, slope } = seen(camera);
      this.sort([...rows[2], -rows[2].reduce((sum, value, k) => sum + value * eye[k], 0)]);
      this.arrange(behind);
      if (!this.shown.size || !this.slots.some(({ source, share }) => source && share)) return false;
      this.use_webgl((gl) => {
        this.fit(gl);
        gl.activeTexture(gl.TEXTURE0);
        this.blend(gl, rows, eye, slope);
        this.cover(gl, rows, slope);
      });
      return true;
    }

    // The image in which splats are blended is as large as the canvas, if that isn't too large.
    fit(gl) {
      const { drawingBufferWidth: width, drawingBufferHeight: height } = gl, scale = Math.min(1, Math.sqrt(MAX_PIXELS / (width * height)));
      const size = [width, height].map((side) => Math.max(1, Math.round(side * scale)));
      gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
      if (size.every((side, k) => side === this.size[k])) return;
      this.size = size;
      gl.bindTexture(gl.TEXTURE_2D, this.image);
      gl.texImage2D(gl.TEXTURE_2D, 0, this.format[0], ...size, 0, gl.RGBA, this.format[1], null);
      gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.image, 0);
    }

    // Blend the splats, nearest first: colours times alpha, and in the alpha channel what is left of the background.
    blend(gl, rows, eye, slope) {
      const at = (name) => gl.getUniformLocation(this.blending, name), [width, height] = this.size;
      gl.viewport(0, 0, width, height);
      gl.clearColor(0, 0, 0, 1);
      gl.clear(gl.COLOR_BUFFER_BIT);
      gl.enable(gl.BLEND);
      gl.blendFuncSeparate(gl.DST_ALPHA, gl.ONE, gl.ZERO, gl.ONE_MINUS_SRC_ALPHA);
      gl.useProgram(this.blending);
      gl.uniformMatrix3fv(at("rotation"), true, rows.flat());
      gl.uniform3fv(at("eye"), eye);
      gl.uniform2f(at("focal"), width / 2 / slope[0], height / 2 / slope[1]);
      gl.uniform2f(at("size"), width, height);
      gl.uniform1f(at("max_colour"), this.max_colour);
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.bindVertexArray(this.vertices);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
      gl.bindVertexArray(null);
      gl.disable(gl.BLEND);
    }

    // Copy them into the canvas, before the backgrounds.
    cover(gl, rows, slope) {
      const at = (name) => gl.getUniformLocation(this.covering, name);
      const shares = this.slots.map(({ source, share }) => (source ? share : 0)), sum = shares.reduce((a, b) => a + b);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
      gl.useProgram(this.covering);
      gl.uniformMatrix3fv(at("towards"), false, rows.flat());
      gl.uniform2fv(at("slope"), slope);
      gl.uniform1i(at("image"), 0);
      gl.uniform1iv(at("backgrounds"), this.slots.map((_, k) => k + 1));
      gl.uniform1fv(at("weights"), this.slots.map(({ scale }, k) => (scale * shares[k]) / sum));
      gl.bindTexture(gl.TEXTURE_2D, this.image);
      for (const [k, { texture }] of this.slots.entries()) {
        gl.activeTexture(gl.TEXTURE1 + k);
        gl.bindTexture(gl.TEXTURE_2D, texture);
      }
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }

  window.scan2sim.Splats = Splats;
})();
