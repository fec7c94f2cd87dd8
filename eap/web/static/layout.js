// Places of the graph's nodes, and the ways of its arrows.

const STEPS = 720;
const MARGIN = 24; // arrows between two stations bend

/** Return the centre of each node, and the height that they need.
 *
 *  Nodes stand on an ellipse in the order of the plant; one that is linked to most others stands in
 *  its middle.
 */
export function placeNodes(names, arrows, width, box) {
  const hub = findHub(names, arrows);
  const ring = names.filter((name) => name !== hub);
  const places = new Map();
  const room = ring.length * (box.width + 30);
  const radiusX = Math.min(width / 2 - box.width / 2 - 6, Math.max(290, room / 4));
  if (ring.length < 3 && !hub && 2 * radiusX < box.width + 130) return stack(names, width, box);
  const radiusY = ring.length < 3 ? 0 : Math.max(hub ? 150 : 100, (room - 4 * radiusX) / 4, ring.length * 17);
  const middle = { x: width / 2, y: 0 };
  if (names.length === 1) places.set(names[0], middle);
  else spread(ring, middle, radiusX, radiusY, places);
  if (hub) places.set(hub, { ...middle });
  const ys = [...places.values()].map((each) => each.y);
  const top = box.height / 2 + MARGIN - Math.min(...ys);
  for (const [name, { x, y }] of places) places.set(name, { x, y: y + top });
  return { places, height: Math.max(...ys) + top + box.height / 2 + MARGIN };
}

function stack(names, width, box) {
  const pitch = box.height + 70;
  const places = new Map(names.map((name, index) => [name, { x: width / 2, y: box.height / 2 + 4 + index * pitch }]));
  return { places, height: (names.length - 1) * pitch + box.height + 8 };
}

function findHub(names, arrows) {
  if (names.length < 5) return null;
  const near = new Map(names.map((name) => [name, new Set()]));
  for (const { sender, receiver } of arrows) {
    near.get(sender).add(receiver);
    near.get(receiver).add(sender);
  }
  const [first, second] = [...near].sort(([, one], [, other]) => other.size - one.size);
  return first[1].size > 0.6 * (names.length - 1) && first[1].size >= 2 * second[1].size ? first[0] : null;
}

/** Place nodes with equal distances along an ellipse. */
function spread(names, middle, radiusX, radiusY, places) {
  const start = names.length < 3 ? Math.PI : -Math.PI / 2;
  const point = (step) => {
    const angle = start + (2 * Math.PI * step) / STEPS;
    return { x: middle.x + radiusX * Math.cos(angle), y: middle.y + radiusY * Math.sin(angle) };
  };
  const lengths = [0];
  for (let step = 1; step <= STEPS; step += 1) {
    const [one, other] = [point(step - 1), point(step)];
    lengths.push(lengths[step - 1] + Math.hypot(other.x - one.x, other.y - one.y));
  }
  names.forEach((name, index) => {
    const wanted = (lengths[STEPS] * index) / names.length;
    places.set(name, point(lengths.findIndex((length) => length >= wanted - 1e-9)));
  });
}

/** Return the path of an arrow between two boxes, and the place of its label. */
export function routeArrow(from, to, hasReverse, box) {
  const distance = Math.hypot(to.x - from.x, to.y - from.y) || 1;
  const bend = hasReverse ? 26 : 0;
  const across = { x: (-(to.y - from.y) / distance) * bend, y: ((to.x - from.x) / distance) * bend };
  const control = { x: (from.x + to.x) / 2 + across.x, y: (from.y + to.y) / 2 + across.y };
  const start = edge(from, control, box);
  const end = edge(to, control, box);
  const at = (one, other, third) => 0.25 * one + 0.5 * other + 0.25 * third;
  const round = (number) => Math.round(number * 10) / 10;
  return {
    path: `M${round(start.x)} ${round(start.y)}Q${round(control.x)} ${round(control.y)} ${round(end.x)} ${round(end.y)}`,
    x: round(at(start.x, control.x, end.x)),
    y: round(at(start.y, control.y, end.y)),
  };
}

/** Return the point of a box's edge on the way from its centre to a point. */
function edge(centre, point, box) {
  const x = point.x - centre.x;
  const y = point.y - centre.y;
  const scale = Math.min((box.width / 2 + 3) / Math.abs(x || 1e-9), (box.height / 2 + 3) / Math.abs(y || 1e-9));
  return { x: centre.x + x * Math.min(scale, 1), y: centre.y + y * Math.min(scale, 1) };
}
