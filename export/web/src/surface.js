// The surface in 3-D: coloured by the compressive traction on it, over its grid at rest, with contact points and the total force.
import {
  AmbientLight, BufferAttribute, BufferGeometry, CanvasTexture, ConeGeometry, CylinderGeometry, DirectionalLight, DoubleSide,
  Group, LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera, Raycaster, Scene,
  SphereGeometry, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

export const COLOURS = ["#fff5eb", "#fdd9b4", "#fda762", "#f3701b", "#c54102", "#7f2704"];
const ARROW = "#0072b2";
const REST = "#52697d";
const VIEW = new Vector3(0.4, -1, 0.75).normalize(); // from where the surface is seen first; z points away from its camera
const FIELD = 30; // of view, degrees
const MARGIN = 1.06;
const KEY_TURN = 0.12; // rad
const KEY_ZOOM = 0.9;
const ARROW_LENGTH = 0.5; // of the surface's radius

const SCALE = scale(); // between vertices the value is interpolated, not the colour

/** Shows one sensor's surface in a canvas. */
export class Surface {
  #scene = new Scene();
  #shown = new Group();
  #camera = new PerspectiveCamera(FIELD);
  #renderer;
  #controls;
  #mesh;
  #radius = 1;
  #stale = true; // the canvas shows something else than the scene

  constructor(canvas) {
    this.#renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.#camera.up.set(0, 0, 1);
    this.#camera.position.copy(VIEW);
    const light = new DirectionalLight("white", 1.6);
    light.position.set(-0.6, 0.8, 0.3);
    this.#camera.add(light);
    this.#scene.add(this.#shown, this.#camera, new AmbientLight("white", 1.5));
    this.#controls = new OrbitControls(this.#camera, canvas);
    this.#controls.enablePan = false;
    canvas.style.touchAction = "pan-y"; // a finger moved along the page scrolls it, across it turns the surface
    this.#controls.autoRotateSpeed = 1; // a turn a minute
    this.#controls.addEventListener("change", () => (this.#stale = true));
    canvas.addEventListener("keydown", (event) => this.#key(event));
    new ResizeObserver(() => this.#fit()).observe(canvas);
    let before = 0;
    this.#renderer.setAnimationLoop((now) => {
      this.#controls.update((now - before) / 1000);
      if (this.#stale) this.#renderer.render(this.#scene, this.#camera);
      this.#stale = false;
      before = now;
    });
  }

  set turning(turning) {
    this.#controls.autoRotate = turning;
  }

  /** Takes another sensor's mesh and shows it at rest. */
  begin(mesh) {
    this.#mesh = { rest: Float32Array.from(mesh.rest_vertices.flat()), triangles: mesh.triangles.flat(), edges: edges(mesh.grid) };
    this.show(this.#mesh.rest, new Float32Array(mesh.rest_vertices.length), 1);
    const body = geometry(this.#mesh.rest, this.#mesh.triangles);
    body.computeBoundingSphere();
    this.#radius = body.boundingSphere.radius;
    this.#controls.target.copy(body.boundingSphere.center);
    this.#camera.position.copy(body.boundingSphere.center).add(VIEW);
    this.#fit();
  }

  /** Shows `vertices` [3 V], coloured by `values` [V] from 0 to `most`, contact points [P][3] and the total force [3]. */
  show(vertices, values, most, contacts = [], force = null) {
    const { rest, triangles, edges } = this.#mesh;
    this.clear();
    const body = geometry(vertices, triangles);
    body.setAttribute("uv", new BufferAttribute(Float32Array.from([...values].flatMap((value) => [value / most, 0])), 2));
    body.computeVertexNormals();
    const skin = new Mesh(body, new MeshLambertMaterial({ map: SCALE, side: DoubleSide }));
    Object.assign(skin.material, { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 }); // lines stay visible
    this.#shown.add(skin, lines(vertices, edges, "#5b3a24", 0.3), lines(rest, edges, REST, 0.6));
    for (const contact of contacts) {
      const dot = solid(new SphereGeometry(0.026 * this.#radius), "black");
      dot.position.fromArray(contact);
      this.#shown.add(dot);
    }
    if (force) this.#shown.add(this.#arrow(skin, centre(vertices, values), new Vector3(...force).normalize()));
  }

  clear() {
    this.#shown.traverse((part) => (part.geometry?.dispose(), part.material?.dispose()));
    this.#shown.clear();
    this.#stale = true;
  }

  /** The total force where its line of action, through the centre of pressure, meets the surface from outside. */
  #arrow(skin, centre, direction) {
    skin.updateMatrixWorld();
    const [hit] = new Raycaster(centre.clone().addScaledVector(direction, -4 * this.#radius), direction).intersectObject(skin);
    const arrow = new Group().add(solid(new ConeGeometry(0.055, 0.17).translate(0, -0.085, 0), ARROW));
    arrow.add(solid(new CylinderGeometry(0.016, 0.016, ARROW_LENGTH).translate(0, -ARROW_LENGTH / 2 - 0.1, 0), ARROW));
    arrow.position.copy(hit?.point ?? centre);
    arrow.quaternion.setFromUnitVectors(new Vector3(0, 1, 0), direction);
    arrow.scale.setScalar(this.#radius);
    return arrow;
  }

  /** Keeps the surface in view, from the direction it is seen now. */
  #fit() {
    const { clientWidth: width, clientHeight: height } = this.#renderer.domElement;
    if (!width || !height) return;
    this.#renderer.setPixelRatio(devicePixelRatio);
    this.#renderer.setSize(width, height, false);
    const across = (FIELD * Math.PI) / 360;
    const half = Math.min(across, Math.atan((Math.tan(across) * width) / height));
    const distance = (MARGIN * this.#radius) / Math.sin(half);
    const { position } = this.#camera;
    position.sub(this.#controls.target).setLength(distance).add(this.#controls.target);
    Object.assign(this.#camera, { aspect: width / height, near: 0.05 * distance, far: 20 * distance });
    Object.assign(this.#controls, { minDistance: 0.3 * distance, maxDistance: 3 * distance });
    this.#camera.updateProjectionMatrix();
    this.#stale = true;
  }

  #key(event) {
    const turns = { ArrowLeft: [1, 0], ArrowRight: [-1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (turns) {
      this.#controls.rotateLeft(KEY_TURN * turns[0]);
      this.#controls.rotateUp(KEY_TURN * turns[1]);
    } else if (event.key === "+") this.#controls.dollyIn(KEY_ZOOM);
    else if (event.key === "-") this.#controls.dollyOut(KEY_ZOOM);
    else return;
    event.preventDefault();
  }
}

const geometry = (vertices, index) =>
  new BufferGeometry().setAttribute("position", new BufferAttribute(vertices, 3)).setIndex([...index]);

const solid = (shape, color) => new Mesh(shape, new MeshBasicMaterial({ color }));

const lines = (vertices, edges, color, opacity) =>
  new LineSegments(geometry(vertices, edges), new LineBasicMaterial({ color, opacity, transparent: true }));

/** The colour bar as a texture, 0 at its left end. */
function scale() {
  const bar = Object.assign(document.createElement("canvas"), { width: 256, height: 1 }).getContext("2d");
  const gradient = bar.createLinearGradient(0, 0, 256, 0);
  COLOURS.forEach((colour, k) => gradient.addColorStop(k / (COLOURS.length - 1), colour));
  bar.fillStyle = gradient;
  bar.fillRect(0, 0, 256, 1);
  return Object.assign(new CanvasTexture(bar.canvas), { colorSpace: SRGBColorSpace });
}

/** Pairs of neighbours on a grid of m x n vertices, row-major. */
function edges([m, n]) {
  const pairs = [];
  for (let k = 0; k < m * n; k++) {
    if ((k + 1) % n) pairs.push(k, k + 1);
    if (k + n < m * n) pairs.push(k, k + n);
  }
  return pairs;
}

/** The mean of the vertices, weighted by the values above 0. */
function centre(vertices, values) {
  const sum = new Vector3();
  let weight = 0;
  values.forEach((value, k) => {
    sum.addScaledVector(new Vector3().fromArray(vertices, 3 * k), Math.max(value, 0));
    weight += Math.max(value, 0);
  });
  return sum.divideScalar(weight);
}
