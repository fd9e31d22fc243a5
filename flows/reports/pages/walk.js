// 3D view of a world: orbit from above, or walk at eye height. Classic scripts, because a page opened from a file (file://)
// can't load modules or fetch data: world.js calls scan2simWorld with the GLB as base64, splats_data.js scan2simSplats with
// splats and their background. Other pages build on window.scan2sim.
"use strict";

(() => {
  const EYE_HEIGHT = 1.6; // metres above the ground
  const CELL_SIZE = 1; // metres: edge of the grid cells that index the ground's triangles
  const MAX_STEP_HEIGHT = 0.6; // metres above the feet: higher surfaces are not walked onto
  const WALK_SPEED = 3.5; // metres per second; four times as fast with Shift
  const SKY_COLOUR = 0xc8d6e6;
  const CEILING = "ceiling"; // `CEILING` of pipeline/core/classes.py: would hide rooms from above
  const CEILINGS = 1; // layer of its meshes, which orbiting doesn't show
  const MOVES = {
    KeyW: [0, 1], ArrowUp: [0, 1], KeyS: [0, -1], ArrowDown: [0, -1],
    KeyA: [-1, 0], ArrowLeft: [-1, 0], KeyD: [1, 0], ArrowRight: [1, 0],
  };

  // Load scripts of a folder on demand, so that the page itself loads quickly.
  async function load(folder, names) {
    for (const name of names) {
      await new Promise((done, fail) => {
        const script = document.createElement("script");
        script.src = `${folder}/${name}`;
        const end = (then) => () => {
          script.remove(); // frees the data in it
          then();
        };
        script.onload = end(done);
        script.onerror = end(() => fail(new Error(`${folder}/${name} isn't beside this page`)));
        document.head.append(script);
      });
    }
  }

  // Bytes of a base64 string; Uint8Array.from would need many times their memory.
  function bytes(base64) {
    if (Uint8Array.fromBase64) return Uint8Array.fromBase64(base64);
    const letters = atob(base64), decoded = new Uint8Array(letters.length);
    for (let i = 0; i < decoded.length; i++) decoded[i] = letters.charCodeAt(i);
    return decoded;
  }

  // Unlit meshes of a GLB, converted to z up as in the simulator and moved by an offset in metres.
  async function meshes(base64, offset = [0, 0, 0]) {
    const { scene } = await new THREE.GLTFLoader().parseAsync(bytes(base64).buffer, "");
    scene.rotation.x = Math.PI / 2;
    scene.position.set(...offset);
    scene.updateMatrixWorld();
    const found = [];
    scene.traverse((node) => {
      if (!node.isMesh) return;
      const map = node.material.map;
      if (map) map.anisotropy = 8;
      const material = new THREE.MeshBasicMaterial({ map, side: THREE.DoubleSide });
      const mesh = new THREE.Mesh(node.geometry.applyMatrix4(node.matrixWorld), material);
      mesh.name = node.name;
      mesh.userData = node.userData;
      found.push(mesh);
    });
    return found;
  }

  // Height of the ground: index of its triangles by the grid cells that they touch.
  class Ground {
    constructor(all) {
      const terrain = all.filter((mesh) => mesh.name.startsWith("terrain"));
      this.cells = new Map();
      for (const { geometry } of terrain.length ? terrain : all) {
        const xyz = geometry.attributes.position.array, index = geometry.index.array;
        for (let i = 0; i < index.length; i += 3) this.add([0, 1, 2].map((k) => xyz.subarray(3 * index[i + k], 3 * index[i + k] + 3)));
      }
    }

    add(corners) {
      const [low, high] = [Math.min, Math.max].map((end) => [0, 1].map((k) => Math.floor(end(...corners.map((c) => c[k])) / CELL_SIZE)));
      for (let x = low[0]; x <= high[0]; x++) {
        for (let y = low[1]; y <= high[1]; y++) {
          const key = `${x},${y}`;
          if (!this.cells.has(key)) this.cells.set(key, []);
          this.cells.get(key).push(corners);
        }
      }
    }

    // Height of the highest ground at (x, y) up to `top`; the lowest ground if all is above; null if there is none.
    height(x, y, top) {
      let below = null, lowest = null;
      for (const [a, b, c] of this.cells.get(`${Math.floor(x / CELL_SIZE)},${Math.floor(y / CELL_SIZE)}`) ?? []) {
        const area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]);
        const u = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area;
        const v = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area;
        if (!(u >= 0 && v >= 0 && u + v <= 1)) continue;
        const z = a[2] + u * (b[2] - a[2]) + v * (c[2] - a[2]);
        if (z <= top && (below === null || z > below)) below = z;
        if (lowest === null || z < lowest) lowest = z;
      }
      return below ?? lowest;
    }
  }

  class View {
    // box: element of the view; about: start poses `walk` and `turn` as [eye, target] in metres, `start`: one of the two,
    // `sky`: colour of the background, sRGB 0 to 255, or null
    constructor(box, all, about) {
      this.box = box;
      this.about = about;
      this.renderer = new THREE.WebGLRenderer({ antialias: true });
      this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
      this.canvas = this.renderer.domElement;
      this.canvas.tabIndex = 0;
      this.canvas.setAttribute("aria-label", "3D view of the world; W A S D or arrow keys walk, dragging looks around");
      box.prepend(this.canvas);
      this.scene = new THREE.Scene();
      this.sky = new THREE.Color(about.sky ? `rgb(${about.sky.join(",")})` : SKY_COLOUR);
      this.tiles = new Map(); // name to the meshes
      this.grounds = new Map();
      this.splats = null; // Splats (splats.js), drawn instead of the surfaces of their tiles if `splatted`
      this.splatted = false;
      if (all.length) this.put("world", all);
      this.camera = new THREE.PerspectiveCamera(65, 1, 0.05, 5000);
      this.camera.up.set(0, 0, 1);
      this.orbit = new THREE.OrbitControls(this.camera, this.canvas);
      this.orbit.maxPolarAngle = Math.PI / 2 - 0.02;
      this.orbit.addEventListener("change", () => (this.stale = true));
      this.held = new Set();
      this.output = box.querySelector("output") ?? document.querySelector("output");
      this.listen();
      new ResizeObserver(() => this.fit()).observe(box);
      this.fit();
      this.mode(about.start);
      let before = performance.now();
      const frame = (now) => {
        this.move(Math.min(0.25, (now - before) / 1000));
        before = now;
        if (this.stale) this.draw();
        requestAnimationFrame(frame);
      };
      requestAnimationFrame(frame);
    }

    // Add the meshes of a tile to the scene, and to the ground if they are `solid`.
    put(name, found, solid = true) {
      for (const mesh of found) if (mesh.name.startsWith(CEILING)) mesh.layers.set(CEILINGS);
      this.scene.add(...found);
      this.tiles.set(name, found);
      if (solid) this.grounds.set(name, new Ground(found));
      this.stale = true;
    }

    // As Ground.height, over all meshes.
    height(x, y, top) {
      const found = [...this.grounds.values()].map((ground) => ground.height(x, y, top)).filter((z) => z !== null);
      const below = found.filter((z) => z <= top);
      return found.length ? (below.length ? Math.max(...below) : Math.min(...found)) : null;
    }

    fit() {
      const { clientWidth: width, clientHeight: height } = this.box;
      this.renderer.setSize(width, height, false);
      this.camera.aspect = width / Math.max(1, height);
      this.camera.fov = this.camera.aspect > 1 ? 50 : 65; // vertical degrees; phones are narrow
      this.camera.updateProjectionMatrix();
      this.stale = true;
    }

    mode(name) {
      this.walking = name === "walk";
      this.box.dataset.mode = name;
      this.orbit.enabled = !this.walking;
      this.camera.layers[this.walking ? "enable" : "disable"](CEILINGS);
      const [eye, target] = this.about[name].map((place) => new THREE.Vector3(...place));
      this.camera.position.copy(eye);
      this.camera.lookAt(target);
      if (!this.walking) this.orbit.target.copy(target);
      this.face();
    }

    // Take the walking direction from the camera.
    face() {
      const ahead = this.camera.getWorldDirection(new THREE.Vector3());
      this.turn = Math.atan2(ahead.y, ahead.x);
      this.tilt = Math.asin(ahead.z);
      this.stale = true;
    }

    // Connect the buttons in an element that walk while they are held.
    pads(within) {
      within.querySelectorAll("[data-key]").forEach((button) => {
        for (const kind of ["pointerdown", "pointerup", "pointerleave", "pointercancel"]) {
          button.addEventListener(kind, () => this.hold(button.dataset.key, kind === "pointerdown"));
        }
        button.addEventListener("contextmenu", (event) => event.preventDefault());
      });
    }

    listen() {
      const keys = (event, down) => {
        if (!(event.code in MOVES) || !this.walking || event.ctrlKey || event.metaKey) return;
        event.preventDefault();
        this.hold(event.code, down);
        this.fast = event.shiftKey;
      };
      this.canvas.addEventListener("keydown", (event) => keys(event, true));
      this.canvas.addEventListener("keyup", (event) => keys(event, false));
      this.canvas.addEventListener("blur", () => this.held.clear());
      let finger = null; // last event of the pointer that looks around
      this.canvas.addEventListener("pointerdown", (event) => {
        this.canvas.focus({ preventScroll: true });
        if (!this.walking || finger) return;
        finger = event;
        this.canvas.setPointerCapture(event.pointerId);
      });
      this.canvas.addEventListener("pointermove", (event) => {
        if (!this.walking || finger?.pointerId !== event.pointerId) return;
        const pixel = (this.camera.fov * Math.PI) / 180 / this.box.clientHeight; // the dragged point stays under the finger
        this.turn += (event.clientX - finger.clientX) * pixel;
        this.tilt = THREE.MathUtils.clamp(this.tilt + (event.clientY - finger.clientY) * pixel, -1.5, 1.5);
        finger = event;
        this.look();
      });
      for (const end of ["pointerup", "pointercancel"]) {
        this.canvas.addEventListener(end, (event) => (finger = finger?.pointerId === event.pointerId ? null : finger));
      }
    }

    hold(code, down) {
      if (down) this.held.add(code);
      else this.held.delete(code);
    }

    look() {
      const ahead = new THREE.Vector3(Math.cos(this.turn) * Math.cos(this.tilt), Math.sin(this.turn) * Math.cos(this.tilt), Math.sin(this.tilt));
      this.camera.lookAt(ahead.add(this.camera.position));
      this.stale = true;
    }

    move(seconds) {
      if (!this.walking || !this.held.size) return;
      const way = WALK_SPEED * (this.fast ? 4 : 1) * seconds;
      let [right, ahead] = [0, 0];
      for (const code of this.held) [right, ahead] = [right + MOVES[code][0], ahead + MOVES[code][1]];
      const eye = this.camera.position, [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
      eye.x += way * (ahead * cos + right * sin);
      eye.y += way * (ahead * sin - right * cos);
      const ground = this.height(eye.x, eye.y, eye.z - EYE_HEIGHT + MAX_STEP_HEIGHT);
      if (ground !== null) eye.z += (ground + EYE_HEIGHT - eye.z) * Math.min(1, 12 * seconds);
      this.stale = true;
    }

    // Names of the tiles whose backgrounds are behind the splats, and their shares.
    behind() {
      return [["world", 1]];
    }

    // Whether splats are drawn in place of a tile's surfaces.
    covers(name) {
      return this.splats.shows(name);
    }

    // Draw the sky or, if they are shown, splats, and then the meshes. Surfaces that splats cover only hide what is behind.
    draw() {
      this.stale = false;
      const splats = this.splatted && this.splats.draw(this.camera, this.behind());
      for (const [name, found] of this.tiles) for (const { material } of found) material.colorWrite = !(splats && this.covers(name));
      this.scene.background = splats ? null : this.sky;
      this.renderer.autoClear = !splats;
      if (splats) this.renderer.clearDepth();
      this.renderer.render(this.scene, this.camera);
      this.output.value = this.camera.position.toArray().map((v) => v.toFixed(2)).join("  ");
    }
  }

  // Load the splats, show them, and connect the buttons that choose between them and the surfaces.
  async function add_splats(box, view) {
    const parts = await new Promise((got, fail) => {
      window.scan2simSplats = (...given) => got(given);
      load(box.dataset.folder, ["splats.js", "splats_data.js"]).catch(fail);
    });
    window.scan2simSplats = null; // it holds the parts
    view.splats = new window.scan2sim.Splats(view.renderer, [view.about.splats], () => (view.stale = true));
    view.splats.put("world", parts);
    const buttons = box.querySelectorAll("[data-show]");
    const show = (what) => {
      view.splatted = what === "splats";
      view.stale = true;
      buttons.forEach((button) => button.setAttribute("aria-pressed", String(button.dataset.show === what)));
    };
    buttons.forEach((button) => button.addEventListener("click", () => show(button.dataset.show)));
    show("splats");
    box.dataset.splats = "loaded";
  }

  // Load the world and open the view in `box`, with attributes `data-folder` (of the scripts) and `data-about` (see View).
  async function open(box) {
    const say = (text) => (box.querySelector("[role=status]").textContent = text);
    box.dataset.state = "loading";
    say("Loading the world …");
    try {
      const base64 = await new Promise((got, fail) => {
        window.scan2simWorld = got;
        load(box.dataset.folder, ["three.js", "world.js"]).catch(fail);
      });
      const about = JSON.parse(box.dataset.about), view = new View(box, await meshes(base64), about);
      box.querySelectorAll("[data-to]").forEach((button) => button.addEventListener("click", () => view.mode(button.dataset.to)));
      view.pads(box);
      const full = box.querySelector("[data-full]");
      full.hidden = !document.fullscreenEnabled;
      full.addEventListener("click", () => (document.fullscreenElement ? document.exitFullscreen() : box.requestFullscreen()));
      say("");
      box.dataset.state = "open";
      view.canvas.focus({ preventScroll: true });
      if (about.splats) add_splats(box, view).catch((error) => say(`The splats can't be shown: ${error.message}.`));
    } catch (error) {
      box.dataset.state = "failed";
      say(/webgl/i.test(error.message) ? "This browser has no WebGL, which the 3D view needs; the image shows the world." : `The world can't be shown: ${error.message}.`);
    }
  }

  window.scan2sim = { View, bytes, load, meshes };
  for (const box of document.querySelectorAll("header[data-about]")) box.querySelector("[data-open]").addEventListener("click", () => open(box));
})();
