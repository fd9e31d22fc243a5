// Exports of three.js (MIT, three-LICENSE.txt) that the pages need. To rebuild three.js, in a separate folder:
//   npm install three@0.187.0 esbuild@0.28.2
//   npx esbuild three.entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=inline --outfile=three.js

export { BufferAttribute, Color, DoubleSide, LinearMipmapLinearFilter, MathUtils, Mesh, MeshBasicMaterial, PerspectiveCamera, Scene, SRGBColorSpace, Vector3, WebGLRenderer } from "three";
export { OrbitControls } from "three/examples/jsm/controls/OrbitControls.js";
export { GLTFLoader } from "three/examples/jsm/loaders/GLTFLoader.js";
