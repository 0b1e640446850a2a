// What the pages that show plans share: the bin, the tote and the gripper in 3D. A page sets `$`, `data` and `resetView`.
// ------------------------------------------------------------------ the scene; one unit is one cell, z is up
const [binW, binD, binH] = data.bin, [toteW, toteD] = data.tote, [eeW, eeD] = data.effector;
const gap = Math.max(2, 0.25 * toteW), [binX, binY] = data.binAt ?? [-binW - gap, (toteD - binD) / 2];
const INK = 0x263238, BAD = 0xd32f2f, TARGET = 0xc2410c;
function makeRenderer() {
  try {
    return new THREE.WebGLRenderer({ antialias: true, preserveDrawingBuffer: true });
  } catch (error) {
    const words = document.createElement("p");
    words.setAttribute("role", "alert");
    words.style.padding = "0 24px";
    words.textContent = "This browser has no WebGL, so nothing can be shown in 3D. Switch on hardware acceleration, or use another browser.";
    $("stage").prepend(words);
    throw error;
  }
}
const renderer = makeRenderer();
renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
$("stage").prepend(renderer.domElement);
renderer.domElement.setAttribute("role", "img");
renderer.domElement.setAttribute("aria-label", "The bin, the gripper and the tote in 3D; drag to turn, scroll to zoom");
const scene = new THREE.Scene();
scene.background = new THREE.Color(0xf3f5f7);
scene.add(new THREE.HemisphereLight(0xffffff, 0xb8c0c8, 2.1));
const sun = new THREE.DirectionalLight(0xffffff, 1.7);
sun.position.set(-0.6, -1, 1.6);
scene.add(sun);
const camera = new THREE.PerspectiveCamera(22, 1, 1, 5000);
camera.up.set(0, 0, 1);
const controls = new THREE.OrbitControls(camera, renderer.domElement);
controls.maxPolarAngle = 1.5;
let dirty = true, turned = false;  // turned: the viewer has chosen a view, which stays
controls.addEventListener("change", () => { dirty = true; });
controls.addEventListener("start", () => { turned = true; });

const BEHIND_EDGES = { polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 1 };
const material = (color, more = {}) => new THREE.MeshLambertMaterial({ color, ...more });
function addBox(parent, x, y, z, w, d, h, mat) {
  const mesh = new THREE.Mesh(new THREE.BoxGeometry(w, d, h), mat);
  mesh.position.set(x + w / 2, y + d / 2, z + h / 2);
  parent.add(mesh);
  return mesh;
}
function lines(points, color, opacity = 1) {
  const geometry = new THREE.BufferGeometry();
  geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(points), 3));
  return new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color, transparent: opacity < 1, opacity }));
}
const CORNERS = [[0, 0], [1, 0], [1, 1], [0, 1]];
function boxEdges(x, y, z, w, d, h) {
  const points = [];
  CORNERS.forEach(([i, j], n) => {
    const [k, l] = CORNERS[(n + 1) % 4];
    for (const up of [0, h]) points.push(x + i * w, y + j * d, z + up, x + k * w, y + l * d, z + up);
    points.push(x + i * w, y + j * d, z, x + i * w, y + j * d, z + h);
  });
  return points;
}
function container(x, y, w, d, h, color, wallHeight) {
  const group = new THREE.Group();
  addBox(group, x, y, -0.12, w, d, 0.1, material(0xdfe4e8));
  const grid = [];
  for (let i = 1; i < w; i++) grid.push(x + i, y, 0.003, x + i, y + d, 0.003);
  for (let j = 1; j < d; j++) grid.push(x, y + j, 0.003, x + w, y + j, 0.003);
  group.add(lines(grid, 0xb7c0c6));
  const glass = material(color, { transparent: true, opacity: 0.07, side: THREE.DoubleSide, depthWrite: false });
  const t = 0.04;
  for (const [a, b, c, e] of [[x - t, y - t, t, d + 2 * t], [x + w, y - t, t, d + 2 * t], [x, y - t, w, t], [x, y + d, w, t]])
    addBox(group, a, b, 0, c, e, wallHeight, glass).renderOrder = 5;
  group.add(lines(boxEdges(x - t, y - t, 0, w + 2 * t, d + 2 * t, wallHeight), color));
  scene.add(group);
  return group;
}
function label(text, x, y, size) {
  const canvas = document.createElement("canvas"), pen = canvas.getContext("2d"), font = "600 84px system-ui, sans-serif";
  pen.font = font;
  canvas.width = Math.ceil(pen.measureText(text).width) + 16; canvas.height = 128;
  pen.font = font; pen.fillStyle = "#5f6b73"; pen.textAlign = "center"; pen.textBaseline = "middle";
  pen.fillText(text, canvas.width / 2, 64);
  const texture = new THREE.CanvasTexture(canvas);
  texture.anisotropy = 8;
  const plane = new THREE.Mesh(new THREE.PlaneGeometry(size * canvas.width / 128, size), new THREE.MeshBasicMaterial({ map: texture, transparent: true, depthWrite: false }));
  plane.position.set(x, y, -0.1);
  return plane;
}
const big = Math.max(toteW, toteD);
const labelSize = Math.max(0.8, big / 14);
const binLabel = label("bin", binX + binW / 2, binY - 0.9 * labelSize, labelSize);
scene.add(binLabel);

// The end effector: a flat plate, the body, on an arm, with a suction cup for each cell that seals; the cups' rims are at z = 0 of the group.
const gripper = new THREE.Group();
const STEEL = 0x455a64, CUP = 0x263238, PLATE = 0.28;
const plateMaterial = material(STEEL, { transparent: true, opacity: 0.3, depthWrite: false }), cupMaterial = material(CUP);
const plateBoxes = data.body.map(([x, y, w, d]) => [x - eeW / 2 + 0.03, y - eeD / 2 + 0.03, PLATE, w - 0.06, d - 0.06, 0.1]);
for (const box of plateBoxes) addBox(gripper, ...box, plateMaterial).renderOrder = 6;
const plateEdges = lines(plateBoxes.flatMap(box => boxEdges(...box)), CUP);
gripper.add(plateEdges);
const cups = new THREE.InstancedMesh(new THREE.CylinderGeometry(0.1, 0.2, PLATE, 16).rotateX(Math.PI / 2), cupMaterial, data.cups.length);
const dummy = new THREE.Object3D();
for (const [cup, [x, y]] of data.cups.entries()) {
  dummy.position.set(x - eeW / 2 + 0.5, y - eeD / 2 + 0.5, PLATE / 2);
  dummy.updateMatrix();
  cups.setMatrixAt(cup, dummy.matrix);
}
cups.frustumCulled = false;
gripper.add(cups);
const arm = new THREE.Mesh(new THREE.CylinderGeometry(0.16, 0.16, 1, 20), material(0x607d8b));
arm.rotation.x = Math.PI / 2;
gripper.add(arm);
scene.add(gripper);

const carried = new THREE.Mesh(new THREE.BoxGeometry(1, 1, 1), material(0xffffff, { transparent: true, ...BEHIND_EDGES }));
const carriedEdges = new THREE.LineSegments(new THREE.EdgesGeometry(carried.geometry), new THREE.LineBasicMaterial({ color: INK }));
const item = new THREE.Group();
item.add(carried, carriedEdges);
scene.add(item);
// Where the move ends: outlines of the item and of the gripper, seen through everything.
const outline = opacity => new THREE.LineSegments(carriedEdges.geometry, new THREE.LineBasicMaterial({ color: TARGET, depthTest: false, transparent: true, opacity }));
const target = new THREE.Group(), targetItem = outline(1), targetGripper = outline(0.55);
target.add(targetItem, targetGripper);
targetItem.renderOrder = targetGripper.renderOrder = 10;
scene.add(target);
function extendArm(height) {
  const length = 1.5 + 0.25 * height, thick = Math.max(1, Math.min(eeW, eeD) / 3);
  arm.scale.set(thick, length, thick);
  arm.position.z = PLATE + 0.1 + length / 2;
}

const percent = share => `${(Math.floor(1000 * share + 1e-6) / 10).toFixed(1)}%`;  // never rounded up: 100% is full
function dispose(object) { if (object) { scene.remove(object); object.traverse(o => o.geometry?.dispose()); } }

// From the front and above, so far away that bin, tote and raised gripper are all inside the picture.
function frame(height, travel, left = binX) {
  turned = false;
  const low = [left - 0.3, Math.min(0, binY) - 1.5 * labelSize, 0], high = [toteW + 0.3, Math.max(toteD, binY + binD), travel];
  // Corners of the tote up to its rim, of the way of the gripper, and of the labels.
  const points = [
    ...CORNERS.flatMap(([i, j]) => [0, height].map(z => [i ? high[0] : 0, j ? toteD : low[1], z])),
    ...CORNERS.flatMap(([i, j]) => [0, travel + PLATE + 0.8].map(z => [i ? toteW : low[0], j ? binY + binD : binY - 1.5 * labelSize, z])),
  ].map(corner => new THREE.Vector3(...corner));
  const center = new THREE.Vector3(...low).add(new THREE.Vector3(...high)).multiplyScalar(0.5);
  const direction = new THREE.Vector3(0.2, -0.8, 0.6).normalize(), where = new THREE.Vector3();
  for (let distance = 4; distance < 4000; distance *= 1.02) {
    camera.position.copy(center).addScaledVector(direction, distance);
    camera.lookAt(center);
    camera.updateMatrixWorld();
    const seen = points.map(point => where.copy(point).project(camera).toArray());
    const [left, right, bottom, top] = [0, 1].flatMap(k => [Math.min(...seen.map(p => p[k])), Math.max(...seen.map(p => p[k]))]);
    if (right - left > 1.9 || top - bottom > 1.9) continue;
    // Move what is seen into the middle of the picture.
    const half = distance * Math.tan(camera.fov * Math.PI / 360), side = new THREE.Vector3(), up = new THREE.Vector3();
    camera.matrixWorld.extractBasis(side, up, where);
    center.addScaledVector(side, (left + right) / 2 * half * camera.aspect).addScaledVector(up, (bottom + top) / 2 * half);
    camera.position.copy(center).addScaledVector(direction, distance);
    break;
  }
  controls.target.copy(center);
  controls.update();
  dirty = true;
}

function resize() {
  const { clientWidth: width, clientHeight: height } = $("stage");
  if (!width || !height) return;
  renderer.setSize(width, height, false);
  camera.aspect = width / height;
  camera.updateProjectionMatrix();
  if (!turned) resetView();
  dirty = true;
}
