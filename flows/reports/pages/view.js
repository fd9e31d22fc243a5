// Viewer of a world: loads tiles by distance, shows their splats, or their surfaces coloured by photo, class, source or
// photo distance. Classic scripts, so that the page can also be opened from a file: each tile is a script that calls
// scan2simTile with a GLB as base64, and another one that calls it with splats and their background.
"use strict";

(() => {
  const MAX_TEXELS = 320e6; // texture memory of all loaded tiles; above it the farthest are unloaded
  const DISTANCE_COLOURS = [[0, "#30123b"], [5, "#4686fb"], [10, "#1ae4b6"], [20, "#a4fc3c"], [35, "#fb7e21"], [60, "#7a0403"]]; // metres
  const NO_PHOTO_COLOUR = "#8a8f96";
  const SPLATS = "_splats", COLLISION = "_collision"; // after a tile's name: its scripts
  const BLEND_M = 10; // over which the background changes from a tile's to the next one's
  const FIRST_PHOTO_ROW = 3; // row of the first photo in a GLB's table; rows 0 to 2: inpainted, point cloud, unknown photo
  const { Splats, View, load, meshes } = window.scan2sim;

  // Patch a material: where `tinted` is 1, each vertex has a colour that is modulated by the texture's brightness.
  function tintable(material, tinted) {
    material.onBeforeCompile = (shader) => {
      shader.uniforms.tinted = tinted;
      shader.vertexShader = shader.vertexShader
        .replace("#include <common>", "#include <common>\nattribute vec3 tint;\nvarying vec3 vTint;")
        .replace("#include <begin_vertex>", "#include <begin_vertex>\nvTint = tint;");
      shader.fragmentShader = shader.fragmentShader
        .replace("#include <common>", "#include <common>\nuniform float tinted;\nvarying vec3 vTint;")
        .replace("#include <map_fragment>", `#include <map_fragment>
          float bright = pow(dot(diffuseColor.rgb, vec3(.2126, .7152, .0722)), .4545);
          diffuseColor.rgb = mix(diffuseColor.rgb, vTint * (.3 + .9 * bright), tinted);`);
    };
    return material;
  }

  const linear = (colour) => new THREE.Color(colour).toArray();

  function distanceColour(metres) {
    const next = DISTANCE_COLOURS.findIndex(([at]) => at > metres);
    if (next < 0) return linear(DISTANCE_COLOURS[DISTANCE_COLOURS.length - 1][1]);
    const [[low, from], [high, to]] = [DISTANCE_COLOURS[next - 1], DISTANCE_COLOURS[next]];
    return new THREE.Color(from).lerp(new THREE.Color(to), (metres - low) / (high - low)).toArray();
  }

  class World extends View {
    constructor(box, about) {
      super(box, [], about);
      this.camera.far = Math.max(this.camera.far, about.dome?.far ?? 0);
      this.camera.updateProjectionMatrix();
      this.rgb = (of) => linear(`rgb(${of.join(",")})`);
      this.tinted = { value: 0 };
      this.colours = "photo";
      this.shown = { wireframe: false, collision: false };
      this.loaded = new Map(); // script name to the meshes and state of what it loaded
      this.texels = new Map(); // tile name to its texels, once they are known; also of dropped tiles
      if (about.splats) this.splats = new Splats(this.renderer, about.tiles.map(({ splats }) => splats), () => (this.stale = true));
      this.wires = new THREE.MeshBasicMaterial({ color: 0x0a1018, wireframe: true, transparent: true, opacity: 0.45, depthWrite: false });
      this.loop();
    }

    // By how many metres the viewer, or the orbit's centre, is beyond the sides of a tile along x and y; negative inside.
    past({ offset, low, high }) {
      const eye = this.walking ? this.camera.position : this.orbit.target;
      return [0, 1].map((k) => Math.max(offset[k] + low[k] - eye.getComponent(k), eye.getComponent(k) - offset[k] - high[k]));
    }

    // A survey's sky, and the tiles sorted by distance to the viewer, or to the orbit's centre.
    nearest() {
      const away = (tile) => Math.hypot(...this.past(tile).map((side) => Math.max(0, side)));
      return [...(this.about.dome ? [this.about.dome] : []), ...[...this.about.tiles].sort((a, b) => away(a) - away(b))];
    }

    async loop() {
      try {
        for (;;) {
          const next = this.next();
          if (next) await this.fetch(...next);
          else await new Promise((done) => setTimeout(done, 300));
        }
      } catch (error) {
        this.say(error.message);
      }
    }

    // The nearest tiles that fit into memory, and whether their splats do, if splats are shown; drops the others.
    fitting() {
      let texels = MAX_TEXELS, rows = this.splats?.rows ?? 0;
      const kept = [];
      for (const tile of this.nearest()) {
        texels -= this.texels.get(tile.name) ?? 0;
        if (texels < 0) { this.drop(tile.name); continue; }
        const needed = this.splatted && tile.splats ? Splats.rows_of(tile.splats) : 0;
        const possible = needed > 0 && needed <= this.splats.rows; // else the tile shows its surfaces
        if (possible) rows -= needed;
        if (possible && rows < 0) this.splats.drop(tile.name);
        kept.push({ tile, splats: possible && rows >= 0 });
      }
      return kept;
    }

    // Tile and name of the script to load next: visible meshes first, then splats and collision meshes if they are shown.
    next() {
      for (const { tile, splats } of this.fitting()) {
        if (!this.loaded.has(tile.name)) return [tile, tile.name];
        if (splats && !this.splats.has(tile.name)) return [tile, `${tile.name}${SPLATS}`];
        if (this.shown.collision && tile !== this.about.dome && !this.loaded.has(`${tile.name}${COLLISION}`)) return [tile, `${tile.name}${COLLISION}`];
      }
      this.say(this.loaded.size ? "" : "Loading …");
      return null;
    }

    async fetch(tile, name) {
      this.say(`Loading ${name} …`);
      const got = new Promise((done) => (window.scan2simTile = (of, ...parts) => of === name && done(parts)));
      await load("tiles", [`${name}.js`]);
      const parts = await got;
      window.scan2simTile = null; // it holds the parts
      if (name === `${tile.name}${SPLATS}`) return this.splats.put(tile.name, parts, tile.offset);
      const found = await meshes(parts[0], tile.offset);
      const solid = name !== tile.name;
      const texels = found.reduce((sum, { material }) => sum + (material.map ? material.map.image.width * material.map.image.height : 0), 0);
      for (const mesh of found) this.prepare_mesh(mesh, solid);
      if (!solid) this.texels.set(name, texels);
      this.loaded.set(name, { tile, solid, meshes: found });
      if (solid) this.scene.add(...found);
      else this.put(name, found, tile !== this.about.dome);
      this.update_tile(name);
      if (this.walking && !this.about.photos.length) this.stand();
    }

    prepare_mesh(mesh, solid) {
      mesh.geometry.setAttribute("tint", new THREE.BufferAttribute(new Float32Array(3 * mesh.geometry.attributes.position.count).fill(1), 3));
      if (solid) {
        mesh.material = new THREE.MeshBasicMaterial({ color: 0xff8a1f, transparent: true, opacity: 0.3, side: THREE.DoubleSide, polygonOffset: true, polygonOffsetFactor: -2, polygonOffsetUnits: -8 });
      } else {
        tintable(mesh.material, this.tinted);
      }
      const wires = new THREE.Mesh(mesh.geometry, this.wires);
      wires.renderOrder = 1;
      mesh.add(wires);
      mesh.wires = wires;
    }

    drop(name) {
      for (const of of [name, `${name}${COLLISION}`]) {
        const held = this.loaded.get(of);
        if (!held) continue;
        for (const mesh of held.meshes) {
          this.scene.remove(mesh);
          mesh.geometry.dispose();
          mesh.material.map?.dispose();
          mesh.material.dispose();
        }
        this.tiles.delete(of);
        this.grounds.delete(of);
        this.loaded.delete(of);
        this.stale = true;
      }
      this.splats?.drop(name);
    }

    // Update visibility and colours of a tile from the buttons.
    update_tile(name) {
      const { meshes: found, solid } = this.loaded.get(name);
      for (const mesh of found) {
        mesh.visible = !solid || this.shown.collision;
        mesh.wires.visible = solid || this.shown.wireframe;
        if (!solid && this.colours !== "photo") this.tint(mesh);
      }
      this.stale = true;
    }

    tint(mesh) {
      const { tint, _feature_id_0: row, _distance: far } = mesh.geometry.attributes;
      const own = this.rgb(this.about.colours[mesh.userData.class] ?? [138, 143, 150]);
      const sources = this.about.sources.map(this.rgb), none = linear(NO_PHOTO_COLOUR);
      const of = {
        class: () => own,
        source: (i) => (row ? sources[Math.min(row.getX(i), FIRST_PHOTO_ROW - 1)] : none),
        distance: (i) => (far && far.getX(i) >= 0 ? distanceColour(far.getX(i)) : none),
      }[this.colours];
      for (let i = 0; i < tint.count; i++) tint.setXYZ(i, ...of(i));
      tint.needsUpdate = true;
    }

    // Show splats, and textures where a tile has none, or surfaces in one of their colours.
    colour(kind) {
      this.splatted = kind === "splats";
      this.colours = this.splatted ? "photo" : kind;
      this.tinted.value = this.colours === "photo" ? 0 : 1;
      for (const name of this.loaded.keys()) this.update_tile(name);
    }

    toggle(kind) {
      this.shown[kind] = !this.shown[kind];
      for (const name of this.loaded.keys()) this.update_tile(name);
      return this.shown[kind];
    }

    // Move the camera to a photo: same position, direction and field of view.
    photo({ pose, field, aspect }) {
      const [right, down, ahead, eye] = [0, 1, 2, 3].map((k) => new THREE.Vector3(pose[k], pose[4 + k], pose[8 + k]));
      this.mode("walk");
      this.camera.position.copy(eye);
      this.camera.up.copy(down.negate());
      this.camera.lookAt(ahead.add(eye));
      this.camera.up.set(0, 0, 1);
      const wide = this.camera.aspect < aspect ? aspect / this.camera.aspect : 1; // the whole photo fits into the window
      this.camera.fov = (2 * Math.atan(wide * Math.tan((field * Math.PI) / 360)) * 180) / Math.PI;
      this.camera.updateProjectionMatrix();
      this.face();
    }

    mode(name) {
      super.mode(name);
      if (this.walking && !this.about.photos.length) this.stand();
    }

    // Put the viewer on the ground; only photos give a start position at the right height.
    stand() {
      const eye = this.camera.position, ground = this.height(eye.x, eye.y, Infinity);
      if (ground !== null) eye.z = ground + 1.6;
      this.stale = true;
    }

    // Tiles whose splats are loaded, and the shares of their backgrounds: as of the camera in Python (texturing/world_camera.py).
    behind() {
      const signed = (past) => Math.hypot(...past.map((side) => Math.max(0, side))) + Math.min(0, Math.max(...past));
      const tiles = this.about.tiles.filter(({ name }) => this.splats.has(name)).map((tile) => [tile.name, signed(this.past(tile))]);
      const nearest = Math.min(...tiles.map(([, distance]) => distance));
      return tiles.map(([name, distance]) => [name, 1 - (distance - nearest) / BLEND_M]).filter(([, share]) => share > 0);
    }

    covers(name) {
      return name === this.about.dome?.name || super.covers(name);
    }

    say(text) {
      document.querySelector("[role=status]").textContent = text;
    }
  }

  function legend(about, kind) {
    const box = document.getElementById("legend");
    const key = (colour, text) => `<span><i style="background:${colour}"></i>${text}</span>`;
    const css = (rgb) => `rgb(${rgb.join(",")})`;
    const last = DISTANCE_COLOURS[DISTANCE_COLOURS.length - 1][0];
    box.hidden = kind === "photo" || kind === "splats";
    box.innerHTML = {
      photo: () => "",
      splats: () => "",
      class: () => Object.entries(about.colours).map(([name, rgb]) => key(css(rgb), name.replace("_", " "))).join(""),
      source: () => ["inpainted", "from the point cloud", "from a photo"].map((text, i) => key(css(about.sources[i]), text)).reverse().join(""),
      distance: () => `<b style="background:linear-gradient(90deg, ${DISTANCE_COLOURS.map(([at, colour]) => `${colour} ${(100 * at) / last}%`)})"></b><span>0 to ${last} m to the photo</span>${key(NO_PHOTO_COLOUR, "no photo")}`,
    }[kind]();
  }

  const all = (selector) => document.querySelectorAll(selector);
  const press = (buttons, pressed) => buttons.forEach((button) => button.setAttribute("aria-pressed", String(pressed(button))));

  function open() {
    const box = document.getElementById("world"), about = JSON.parse(box.dataset.about);
    const world = (window.world = new World(box, about));
    const select = document.querySelector("#photos select");
    const colour = (kind) => {
      world.colour(kind);
      legend(about, kind);
      press(all("[data-colour]"), (button) => button.dataset.colour === kind);
    };
    all("[data-colour]").forEach((button) => button.addEventListener("click", () => colour(button.dataset.colour)));
    all("[data-toggle]").forEach((button) => button.addEventListener("click", () => button.setAttribute("aria-pressed", String(world.toggle(button.dataset.toggle)))));
    const mode = () => {
      press(all("[data-to]"), (button) => button.dataset.to === box.dataset.mode);
      all("[data-help]").forEach((help) => (help.hidden = help.dataset.help !== box.dataset.mode));
    };
    all("[data-to]").forEach((button) => button.addEventListener("click", () => { world.mode(button.dataset.to); world.fit(); mode(); }));
    document.getElementById("photos").hidden = !about.photos.length;
    select.replaceChildren(...about.photos.map(({ name }, i) => new Option(name, i)));
    select.selectedIndex = Math.floor(about.photos.length / 2);
    const stand = (step) => {
      select.selectedIndex = Math.min(about.photos.length - 1, Math.max(0, select.selectedIndex + step));
      world.photo(about.photos[select.selectedIndex]);
      mode();
    };
    select.addEventListener("change", () => stand(0));
    all("[data-photo]").forEach((button) => button.addEventListener("click", () => stand(Number(button.dataset.photo))));
    world.pads(document);
    colour(about.splats ? "splats" : "photo");
    mode();
    world.canvas.focus();
  }

  try {
    open();
  } catch (error) {
    document.querySelector("[role=status]").textContent = /webgl/i.test(error.message) ? "This browser has no WebGL, which the viewer needs." : error.message;
  }
})();
