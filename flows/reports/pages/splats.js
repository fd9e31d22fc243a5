// 3D Gaussian splats in the canvas of a View (walk.js), by WebGL 2 beside three.js. They look as in the project's own
// renderer (texturing/splats): same projection, kernel, cut-off and low-pass filter, blended nearest first, before a
// background at infinity. three.js' own object ends splats at two standard deviations, and blends otherwise.
"use strict";

(() => {
  const WORDS = 8; // 32-bit words of a splat: pipeline/io/worlds/packed_splats.py
  const SPLATS_IN_ROW = 1024; // of the texture, two texels each
  const MAX_PIXELS = 2.1e6; // of the image in which splats are blended; larger canvases show it enlarged

  const PROJECT = `#version 300 es
    precision highp float;
    precision highp int;
    precision highp usampler2D;
    uniform usampler2D splats;
    uniform mat3 rotation; // from the world to the camera: x right, y down, z ahead
    uniform vec3 eye;
    uniform vec2 focal, size; // pixels
    layout(location = 0) in uint index;
    out vec2 from_centre; // 1 where alpha is MIN_ALPHA
    flat out vec4 colour; // with opacity
    flat out float farthest; // squared standard deviations at the edge

    const float NEAR = .2; // metres
    const float MIN_ALPHA = 1. / 255.;
    const float MAX_COLOUR = 2.; // 1 is white
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
      colour = vec4(vec3(uvec3(first.w, first.w >> 10, first.w >> 20) & 1023u) * (MAX_COLOUR / 1023.), opacity);
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
    uniform sampler2D image, background; // transmittance is the image's alpha
    in vec2 at;
    in vec3 ray;
    out vec4 drawn;

    const float PI = 3.14159265358979;

    void main() {
      vec4 splats = texture(image, at);
      vec2 direction = vec2(atan(ray.y, ray.x) / (2. * PI) + .5, .5 - atan(ray.z, length(ray.xy)) / PI);
      drawn = vec4(splats.rgb + splats.a * texture(background, direction).rgb, 1.);
    }`;

  // A worker: receives positions (x, y, z of each splat), then rows [x, y, z, 1] of depth; returns the order by depth.
  function sorter() {
    const LEVELS = 65536; // 4096 an octave, from 1/8 m
    const FIRST = (127 - 3) * 4096; // level of 1/8 m: a float's upper bits are a logarithm
    let xyz = new Float32Array(0), depth = new Float32Array(1), bits = new Int32Array(depth.buffer), levels = new Uint16Array(0);
    self.onmessage = ({ data }) => {
      if (data.xyz) {
        xyz = data.xyz;
        levels = new Uint16Array(xyz.length / 3);
        return;
      }
      const [a, b, c, d] = data.row, next = new Uint32Array(LEVELS + 1), order = new Uint32Array(levels.length);
      for (let i = 0; i < levels.length; i++) {
        depth[0] = a * xyz[3 * i] + b * xyz[3 * i + 1] + c * xyz[3 * i + 2] + d;
        levels[i] = Math.min(LEVELS - 1, Math.max(0, (bits[0] >> 11) - FIRST));
        next[levels[i] + 1]++;
      }
      for (let k = 0; k < LEVELS; k++) next[k + 1] += next[k];
      for (let i = 0; i < levels.length; i++) order[next[levels[i]]++] = i;
      self.postMessage({ order, version: data.version }, [order.buffer]);
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

  // A camera of three.js: rotation (rows) from the world to x right, y down, z ahead; eye; slopes of the image's edges.
  function seen(camera) {
    camera.updateMatrixWorld();
    const m = camera.matrixWorld.elements, p = camera.projectionMatrix.elements;
    const rows = [[m[0], m[1], m[2]], [-m[4], -m[5], -m[6]], [-m[8], -m[9], -m[10]]];
    return { rows, eye: [m[12], m[13], m[14]], slope: [1 / p[0], 1 / p[5]] };
  }

  // All splats that are loaded, of one tile or several. Sorting takes a while: an order is used until the next one is there.
  class Splats {
    // renderer: of three.js; changed: called when there is something new to draw
    constructor(renderer, changed) {
      this.renderer = renderer;
      this.gl = renderer.getContext();
      this.changed = changed;
      this.tiles = new Map(); // name to the splats' words and the background as a Blob
      this.version = 0; // of the tiles
      this.next = null; // of the newest tiles: names, words, rows of the texture; until they are sorted
      this.shown = new Set(); // names of the tiles in the texture
      this.sorted = { version: 0, row: [] }; // of the last request
      this.waiting = false; // for an order
      this.source = this.blob = null; // background that is drawn, and that is to be drawn, as Blobs
      this.count = 0; // of the splats that are drawn
      this.size = [0, 0]; // of the image in which they are blended
      this.worker = new Worker(URL.createObjectURL(new Blob([`(${sorter})()`])));
      this.worker.onmessage = ({ data }) => this.take_order(data);
      this.use_webgl((gl) => this.prepare(gl));
      renderer.domElement.addEventListener("webglcontextrestored", () => this.restore()); // phones lose it in the background
    }

    // Make again what was lost with the WebGL context.
    restore() {
      this.shown = new Set();
      this.source = this.blob = null;
      this.size = [0, 0];
      this.use_webgl((gl) => this.prepare(gl));
      this.join_tiles();
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
      this.background = texture(gl, gl.LINEAR, gl.REPEAT);
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

    // Add a tile: bytes of its splats and of the JPEG of its background, and its offset in metres.
    put(name, packed, jpeg, offset = [0, 0, 0]) {
      const words = new Uint32Array(packed.buffer), xyz = new Float32Array(packed.buffer);
      for (let i = 0; i < xyz.length; i += WORDS) for (let k = 0; k < 3; k++) xyz[i + k] += offset[k];
      this.tiles.set(name, { words, background: new Blob([jpeg], { type: "image/jpeg" }) });
      this.join_tiles();
    }

    drop(name) {
      if (this.tiles.delete(name)) this.join_tiles();
    }

    // Whether a tile was added, and whether it is drawn already.
    has(name) {
      return this.tiles.has(name);
    }

    shows(name) {
      return this.shown.has(name);
    }

    // Whether the last image is final: nothing is loaded or sorted any more.
    get settled() {
      return !this.waiting && !this.next && this.source !== null && this.source === this.blob;
    }

    // Join all tiles; they are drawn as soon as they are sorted.
    join_tiles() {
      const all = [...this.tiles.values()], count = all.reduce((sum, { words }) => sum + words.length / WORDS, 0);
      const rows = Math.max(1, Math.ceil(count / SPLATS_IN_ROW)), words = new Uint32Array(rows * SPLATS_IN_ROW * WORDS);
      let at = 0;
      for (const tile of all) {
        words.set(tile.words, at);
        at += tile.words.length;
      }
      const places = new Float32Array(words.buffer), xyz = new Float32Array(3 * count);
      for (let i = 0; i < count; i++) for (let k = 0; k < 3; k++) xyz[3 * i + k] = places[WORDS * i + k];
      this.version++;
      this.next = { names: new Set(this.tiles.keys()), words, rows };
      this.worker.postMessage({ xyz }, [xyz.buffer]);
      this.changed();
    }

    // Have the splats sorted by a row of depth, unless they are, or are being sorted.
    sort(row) {
      const same = this.sorted.version === this.version && row.every((value, k) => value === this.sorted.row[k]);
      if (same || this.waiting || !this.version) return;
      this.waiting = true;
      this.sorted = { version: this.version, row };
      this.worker.postMessage(this.sorted);
    }

    // Take an order from the worker, with the tiles that it is of.
    take_order({ order, version }) {
      this.waiting = false;
      if (version === this.version) {
        this.use_webgl((gl) => {
          if (this.next) {
            gl.bindTexture(gl.TEXTURE_2D, this.texture);
            gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32UI, 2 * SPLATS_IN_ROW, this.next.rows, 0, gl.RGBA_INTEGER, gl.UNSIGNED_INT, this.next.words);
          }
          gl.bindBuffer(gl.ARRAY_BUFFER, this.order);
          gl.bufferData(gl.ARRAY_BUFFER, order, gl.DYNAMIC_DRAW);
        });
        this.count = order.length;
        if (this.next) this.shown = this.next.names;
        this.next = null;
      }
      this.changed();
    }

    // Load the background of a tile, unless it is loaded or being loaded.
    async load_background(blob) {
      if (!blob || blob === this.blob) return;
      this.blob = blob;
      const image = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
      if (blob === this.blob) {
        this.use_webgl((gl) => {
          gl.bindTexture(gl.TEXTURE_2D, this.background);
          gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE, image);
        });
        this.source = blob;
        this.changed();
      }
      image.close();
    }

    // Fill the canvas with what a camera sees, before the background of a tile; false: nothing can be drawn yet.
    draw(camera, name) {
      const { rows, eye, slope } = seen(camera);
      this.sort([...rows[2], -rows[2].reduce((sum, value, k) => sum + value * eye[k], 0)]);
      this.load_background(this.tiles.get(name)?.background);
      if (!this.shown.size || !this.source) return false;
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
      gl.bindTexture(gl.TEXTURE_2D, this.texture);
      gl.bindVertexArray(this.vertices);
      gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, this.count);
      gl.bindVertexArray(null);
      gl.disable(gl.BLEND);
    }

    // Copy them into the canvas, before the background.
    cover(gl, rows, slope) {
      const at = (name) => gl.getUniformLocation(this.covering, name);
      gl.bindFramebuffer(gl.FRAMEBUFFER, null);
      gl.viewport(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight);
      gl.useProgram(this.covering);
      gl.uniformMatrix3fv(at("towards"), false, rows.flat());
      gl.uniform2fv(at("slope"), slope);
      gl.uniform1i(at("image"), 0);
      gl.uniform1i(at("background"), 1);
      gl.bindTexture(gl.TEXTURE_2D, this.image);
      gl.activeTexture(gl.TEXTURE1);
      gl.bindTexture(gl.TEXTURE_2D, this.background);
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
  }

  window.scan2sim.Splats = Splats;
})();
