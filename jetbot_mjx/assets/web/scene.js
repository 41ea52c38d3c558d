"use strict";
// Draws robots, goals, trails and a floor with WebGL 2, and finds what is under a pointer.
//
// Frames are those of MuJoCo: metres, z up. Every robot lives at its own origin; the scene moves it to a cell of a
// square. A robot with its goal is one mesh, so that one call draws all robots of a level of detail.

const ROOT = 0; // the body that moves freely
const GOAL_GREEN = [0.18, 0.66, 0.33];
const SUN = [0.321, -0.281, 0.904]; // unit vector
const GHOST_SECONDS = 0.9; // how long a reached goal stays, in simulated seconds
const TRAIL_SECONDS = 2.2;

/** Returns `p` rotated by a quaternion (w, x, y, z). */
function rotated([w, x, y, z], [px, py, pz]) {
  const tx = 2 * (y * pz - z * py), ty = 2 * (z * px - x * pz), tz = 2 * (x * py - y * px);
  return [px + w * tx + y * tz - z * ty, py + w * ty + z * tx - x * tz, pz + w * tz + x * ty - y * tx];
}

/** Shapes of MuJoCo's geoms, each as `points`, `normals` and `faces` (triples of points) before it is placed. */
const Shape = {
  /** A box of half sizes 1. */
  box() {
    const shape = { points: [], normals: [], faces: [] };
    for (let axis = 0; axis < 3; axis++)
      for (const sign of [-1, 1]) {
        const first = shape.points.length;
        for (const [a, b] of [[-1, -1], [1, -1], [1, 1], [-1, 1]]) {
          const point = [0, 0, 0], normal = [0, 0, 0];
          point[axis] = normal[axis] = sign;
          point[(axis + 1) % 3] = a * sign;
          point[(axis + 2) % 3] = b;
          shape.points.push(point);
          shape.normals.push(normal);
        }
        shape.faces.push([first, first + 1, first + 2], [first, first + 2, first + 3]);
      }
    return shape;
  },

  /** A profile turned around z: each strip has two ends, of a radius, a height and the normal's same two parts. */
  turned(strips, sides) {
    const shape = { points: [], normals: [], faces: [] };
    for (const strip of strips) {
      const first = shape.points.length;
      for (const [radius, z, outward, upward] of strip)
        for (let i = 0; i < sides; i++) {
          const angle = (2 * Math.PI * i) / sides, x = Math.cos(angle), y = Math.sin(angle);
          shape.points.push([radius * x, radius * y, z]);
          shape.normals.push([outward * x, outward * y, upward]);
        }
      for (let i = first; i < first + sides; i++) {
        const next = i + 1 < first + sides ? i + 1 : first;
        if (strip[0][0] > 0) shape.faces.push([i, next, next + sides]);
        if (strip[1][0] > 0) shape.faces.push([i, next + sides, i + sides]);
      }
    }
    return shape;
  },

  /** A cylinder of radius 1 and half height 1. */
  cylinder(sides) {
    const cap = (z) => [[z < 0 ? 0 : 1, z, 0, z], [z < 0 ? 1 : 0, z, 0, z]];
    return Shape.turned([cap(-1), [[1, -1, 1, 0], [1, 1, 1, 0]], cap(1)], sides);
  },

  /** A capsule of radius 1, whose halves are `stretch` away from the middle: 0 makes a sphere. */
  capsule(sides, stretch) {
    const quarter = Math.max(2, sides >> 2), ring = (i) => {
      const latitude = (Math.PI / 2) * (i / quarter), radius = Math.abs(i) === quarter ? 0 : Math.cos(latitude);
      return [radius, Math.sin(latitude), radius, Math.sin(latitude)];
    };
    const strips = [];
    for (let i = -quarter; i < quarter; i++) {
      const shift = i < 0 ? -stretch : stretch;
      strips.push([ring(i), ring(i + 1)].map(([radius, z, ...normal]) => [radius, z + shift, ...normal]));
    }
    if (stretch > 0) strips.push([[1, -stretch, 1, 0], [1, stretch, 1, 0]]);
    return Shape.turned(strips, sides);
  },

  /** The triangles of a mesh, each with its own normal. */
  mesh({ vertices, faces }) {
    const xyz = floatsOf(vertices), corners = new Uint32Array(bytesOf(faces).buffer);
    const shape = { points: [], normals: [], faces: [] };
    for (let i = 0; i < corners.length; i += 3) {
      const [a, b, c] = [0, 1, 2].map((k) => [...xyz.subarray(3 * corners[i + k], 3 * corners[i + k] + 3)]);
      const u = b.map((x, k) => x - a[k]), v = c.map((x, k) => x - a[k]);
      const normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
      shape.points.push(a, b, c);
      shape.normals.push(normal, normal, normal);
      shape.faces.push([i, i + 1, i + 2]);
    }
    return shape;
  },
};

/** Returns the shape of a geom and the scale of its axes [m]. */
function shapeOf(geom, meshes, most) {
  const [a, b] = geom.size, sides = most * a < 0.2 ? 6 : most;
  switch (geom.type) {
    case "box": return [Shape.box(), geom.size];
    case "cylinder": return [Shape.cylinder(sides), [a, a, b]];
    case "sphere": return [Shape.capsule(sides, 0), [a, a, a]];
    case "ellipsoid": return [Shape.capsule(sides, 0), geom.size];
    case "capsule": return [Shape.capsule(sides, b / a), [a, a, a]];
    default: return most < LEVELS[0].sides ? [Shape.box(), geom.size] : [Shape.mesh(meshes[geom.mesh]), [1, 1, 1]];
  }
}

// Levels of detail: sides of round parts, the smallest parts, as a share of the robot's radius, and from which radius
// on the level is used [pixels].
const LEVELS = [{ sides: 20, least: 0, from: 16 }, { sides: 8, least: 0.2, from: 6 }, { sides: 6, least: 0.3, from: 0 }];

/** Returns the mesh of some geoms, each in its body's frame: `vertices` of ten numbers (position, normal, colour, body). */
function meshOf(geoms, meshes, sides) {
  const vertices = [], indices = [];
  for (const geom of geoms) {
    const [shape, scale] = shapeOf(geom, meshes, sides), first = vertices.length / 10;
    const colour = geom.rgba.slice(0, 3);
    for (const [i, point] of shape.points.entries()) {
      const place = rotated(geom.quat, point.map((x, k) => x * scale[k]));
      const normal = rotated(geom.quat, shape.normals[i].map((x, k) => x / scale[k]));
      const length = Math.hypot(...normal) || 1;
      vertices.push(...place.map((x, k) => x + geom.pos[k]), ...normal.map((x) => x / length), ...colour, geom.body);
    }
    for (const face of shape.faces) indices.push(...face.map((corner) => first + corner));
  }
  return { vertices, indices };
}

/** Returns the middle x, y and the half sizes x, y, and the largest distance from the origin [m] of a body's geoms. */
function footprint(geoms, meshes) {
  const { vertices } = meshOf(geoms, meshes, LEVELS[1].sides), low = [Infinity, Infinity], high = [-Infinity, -Infinity];
  let radius = 0;
  if (geoms.length === 0) return { middle: [0, 0], half: [0.05, 0.05], radius: 0.1 };
  for (let at = 0; at < vertices.length; at += 10) {
    radius = Math.max(radius, Math.hypot(vertices[at], vertices[at + 1], vertices[at + 2]));
    for (const axis of [0, 1]) {
      low[axis] = Math.min(low[axis], vertices[at + axis]);
      high[axis] = Math.max(high[axis], vertices[at + axis]);
    }
  }
  const middle = low.map((x, k) => (x + high[k]) / 2), half = low.map((x, k) => (high[k] - x) / 2);
  return { middle, half, radius };
}

/** A camera that orbits a point of the floor. Pixels are those of CSS, from the canvas's upper left corner. */
class Camera {
  constructor() {
    Object.assign(this, { yaw: -2.1, pitch: 0.6, distance: 3, target: [0, 0], width: 1, height: 1 });
    this.shift = [0, 0]; // of the target from the canvas's middle, in halves of its width and height
    this.matrix = new Float32Array(16);
    this.eye = new Float32Array(3);
    this.axes = { right: new Float32Array(3), up: new Float32Array(3), forward: new Float32Array(3) };
    this.focal = 1 / Math.tan(0.33);
  }

  /** Computes the matrix from the world to clip space. */
  update() {
    const { yaw, pitch, distance, target, eye, matrix, focal, shift } = this, { right, up, forward } = this.axes;
    const cp = Math.cos(pitch), sp = Math.sin(pitch), cy = Math.cos(yaw), sy = Math.sin(yaw);
    forward.set([-cp * cy, -cp * sy, -sp]);
    right.set([-sy, cy, 0]);
    up.set([-sp * cy, -sp * sy, cp]);
    eye.set([target[0] + distance * cp * cy, target[1] + distance * cp * sy, distance * sp]);
    const near = distance * 0.04, far = distance * 12 + 60, sx = (focal * this.height) / this.width;
    const depth = (far + near) / (far - near), offset = (-2 * far * near) / (far - near);
    for (let k = 0; k < 3; k++) {
      matrix[4 * k] = sx * right[k] + shift[0] * forward[k];
      matrix[4 * k + 1] = focal * up[k] + shift[1] * forward[k];
      matrix[4 * k + 2] = depth * forward[k];
      matrix[4 * k + 3] = forward[k];
    }
    for (let row = 0; row < 4; row++)
      matrix[12 + row] = -(matrix[row] * eye[0] + matrix[4 + row] * eye[1] + matrix[8 + row] * eye[2]);
    matrix[14] += offset;
  }

  /** Writes where a point is seen into `out`: x, y [pixels] and its depth [m]. */
  project(x, y, z, out) {
    const m = this.matrix, w = m[3] * x + m[7] * y + m[11] * z + m[15];
    out[0] = (0.5 + (0.5 * (m[0] * x + m[4] * y + m[8] * z + m[12])) / w) * this.width;
    out[1] = (0.5 - (0.5 * (m[1] * x + m[5] * y + m[9] * z + m[13])) / w) * this.height;
    out[2] = w;
  }

  /** Returns x, y [m] of the plane of height `z` under a pixel; null: it is above the horizon. */
  floorAt(px, py, z = 0) {
    const { right, up, forward } = this.axes, { focal, shift, eye } = this;
    const a = (((2 * px) / this.width - 1 - shift[0]) * this.width) / this.height / focal;
    const b = (1 - (2 * py) / this.height - shift[1]) / focal;
    const ray = [0, 1, 2].map((k) => forward[k] + a * right[k] + b * up[k]);
    if (ray[2] > -0.02) return null;
    const t = (z - eye[2]) / ray[2];
    return [eye[0] + t * ray[0], eye[1] + t * ray[1]];
  }

  /** Moves to a view of `target`, `distance` and `pitch` within some seconds. */
  moveTo(view, seconds) {
    this.way = { ...view, left: seconds };
    if (seconds === 0) this.ease(0);
  }

  /** Goes on with `moveTo` for some seconds. */
  ease(seconds) {
    const { way } = this;
    if (!way) return;
    const share = way.left > seconds ? 1 - Math.pow(1 - seconds / way.left, 2.5) : 1;
    this.distance *= Math.pow(way.distance / this.distance, share);
    this.pitch += share * (way.pitch - this.pitch);
    this.target = this.target.map((x, k) => x + share * (way.target[k] - x));
    way.left -= seconds;
    if (share === 1) this.stop();
  }

  /** Ends `moveTo` where the camera is. */
  stop() {
    this.way = null;
  }

  orbit(dx, dy) {
    this.yaw -= dx * 0.006;
    this.pitch = Math.min(1.54, Math.max(0.08, this.pitch + dy * 0.006));
  }

  /** Moves the floor with the pointer. */
  pan(fromX, fromY, toX, toY) {
    const from = this.floorAt(fromX, fromY), to = this.floorAt(toX, toY);
    if (!from || !to) return;
    const step = [from[0] - to[0], from[1] - to[1]], length = Math.hypot(...step), most = 0.2 * this.distance;
    const share = length > most ? most / length : 1;
    this.target = [this.target[0] + step[0] * share, this.target[1] + step[1] * share];
    this.update();
  }

  /** Zooms by a factor, and keeps the point of the floor under a pixel where it is. */
  zoom(factor, px, py) {
    const before = this.floorAt(px, py);
    this.distance = Math.min(150, Math.max(0.35, this.distance * factor));
    this.update();
    const after = this.floorAt(px, py);
    if (!before || !after) return;
    this.target = [this.target[0] + before[0] - after[0], this.target[1] + before[1] - after[1]];
    this.update();
  }
}

// The pose of a body is two vectors of its robot's row: x, y, z and a scale, and a quaternion. Software renderers take
// long for each instance and each texel, so that a mesh holds copies for several robots, and rows are uniforms.
const ROWS_VECTORS = 1024; // what every browser has room for
const POSE = `
uniform mat4 view;
layout(std140) uniform Rows { vec4 rows[${ROWS_VECTORS}]; };
`;

const BODY_SHADER = [`${POSE}
in vec3 position, normal, colour;
in float row; // where the body's pose is
uniform vec4 green; // colour of a reached goal, and whether these are such
uniform vec3 sun;
out vec3 shade;
vec3 turn(vec4 q, vec3 p) { return p + 2.0 * cross(q.yzw, cross(q.yzw, p) + q.x * p); }
void main() {
  vec4 place = rows[int(row)], q = normalize(rows[int(row) + 1]);
  vec3 n = turn(q, normal);
  shade = mix(colour, green.rgb, green.a) * (0.64 + 0.13 * n.z + 0.33 * max(dot(n, sun), 0.0));
  gl_Position = view * vec4(turn(q, position * place.w) + place.xyz, 1.0);
}`, `
in vec3 shade;
void main() { pixel = vec4(shade, 1.0); }`];

const GRID_LINES = 50, GRID_PARTS = 8; // lines in each direction, and parts of a line

const GRID_SHADER = [`
uniform mat4 view;
uniform vec4 area; // middle x, y [m], how far lines are seen [m], metres of a pixel at a depth of one metre
uniform vec3 eye;
out float fade, side;
void main() {
  int part = gl_VertexID / 6, line = part / ${GRID_PARTS}, corner = gl_VertexID % 6;
  bool alongX = line < ${GRID_LINES};
  float reach = ${GRID_LINES / 2}.0, end = (corner == 1 || corner == 2 || corner == 4) ? 1.0 : 0.0;
  side = (corner == 2 || corner == 4 || corner == 5) ? 1.0 : -1.0;
  vec2 from = floor(area.xy), p;
  float along = ((float(part % ${GRID_PARTS}) + end) / ${GRID_PARTS}.0 * 2.0 - 1.0) * reach;
  float across = float(line % ${GRID_LINES}) - reach + 1.0;
  p = from + (alongX ? vec2(along, across) : vec2(across, along));
  vec3 normal = alongX ? vec3(0.0, 1.0, 0.0) : vec3(1.0, 0.0, 0.0), ray = normalize(vec3(p, 0.0) - eye);
  float depth = (view * vec4(p, 0.0, 1.0)).w, seen = sqrt(max(0.01, 1.0 - dot(normal, ray) * dot(normal, ray)));
  fade = 1.0 - smoothstep(0.2, 1.0, length(p - area.xy) / min(area.z, reach - 1.0));
  gl_Position = view * vec4(vec3(p, 0.0) + normal * side * 1.4 * area.w * depth / seen, 1.0);
}`, `
in float fade, side;
uniform vec3 tint;
void main() { pixel = vec4(tint, fade * (1.0 - smoothstep(0.2, 1.0, abs(side)))); }`];

const DECAL_SHADER = [`${POSE}
in vec4 box; // middle x, y and half sizes x, y in the body's frame [m]
in vec4 shape; // signs of the corner, radius of the box's corners, and softness or width of a ring [m]
in float row;
out vec2 at, edge, halves;
void main() {
  vec4 place = rows[int(row)], q = rows[int(row) + 1];
  vec2 ahead = vec2(1.0 - 2.0 * (q.z * q.z + q.w * q.w), 2.0 * (q.y * q.z + q.x * q.w));
  ahead = length(ahead) > 1e-3 ? normalize(ahead) : vec2(1.0, 0.0);
  at = shape.xy * (box.zw + shape.z + shape.w);
  edge = shape.zw;
  halves = box.zw;
  vec2 p = (box.xy + at) * place.w;
  gl_Position = view * vec4(place.xy + ahead * p.x + vec2(-ahead.y, ahead.x) * p.y, 0.0, 1.0);
}`, `
in vec2 at, edge, halves;
uniform vec4 tint;
uniform float ring; // whether it is a ring
void main() {
  float d = length(max(abs(at) - halves, 0.0)) - edge.x, fill = 1.0 - smoothstep(-edge.y, edge.y, d);
  float line = 1.0 - smoothstep(0.35 * edge.y, edge.y, abs(d));
  pixel = vec4(tint.rgb, tint.a * mix(fill * fill, line, ring));
}`];

const TRAIL_SHADER = [`${POSE}
uniform highp sampler2D points; // x, y [m], and when a robot was there [s], negative at the begin of an episode
uniform ivec2 size; // slots, and vectors of a row, of which the last has the robot's index
uniform vec3 look; // now, the duration of a trail [s], and metres of a pixel at a depth of one metre
out float age;
void main() {
  int part = gl_VertexID >> 2, slot = part % size.x, robot = int(rows[(part / size.x + 1) * size.y - 1].x);
  vec3 start = texelFetch(points, ivec2(robot, slot), 0).xyz;
  vec3 end = texelFetch(points, ivec2(robot, (slot + 1) % size.x), 0).xyz;
  float along = float((gl_VertexID >> 1) & 1), side = float(gl_VertexID & 1) * 2.0 - 1.0, from = abs(start.z);
  vec2 way = end.xy - start.xy, p = mix(start.xy, end.xy, along);
  float depth = (view * vec4(p, 0.0, 1.0)).w;
  vec2 across = length(way) > 1e-5 ? normalize(vec2(-way.y, way.x)) * max(0.007, look.z * depth) : vec2(0.0);
  bool hidden = end.z < from || look.x - from > look.y;
  age = (look.x - mix(from, end.z, along)) / look.y;
  gl_Position = hidden ? vec4(2.0, 2.0, 2.0, 1.0) : view * vec4(p + across * side, 0.0, 1.0);
}`, `
in float age;
uniform vec4 tint;
void main() { pixel = vec4(tint.rgb, tint.a * clamp(1.0 - age, 0.0, 1.0)); }`];

/** A program of a vertex and a fragment shader, with its attributes and uniforms by name. */
class Program {
  constructor(gl, [vertex, fragment]) {
    const program = gl.createProgram(), head = "#version 300 es\nprecision highp float;\n";
    const parts = [[gl.VERTEX_SHADER, head + vertex], [gl.FRAGMENT_SHADER, `${head}out vec4 pixel;\n${fragment}`]];
    for (const [kind, source] of parts) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS) && !gl.isContextLost())
      throw new Error(`a shader does not link: ${gl.getProgramInfoLog(program)}`);
    this.program = program;
    const block = gl.getUniformBlockIndex(program, "Rows");
    if (block !== gl.INVALID_INDEX) gl.uniformBlockBinding(program, block, 0);
    this.uniforms = {};
    for (let i = 0; i < gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS); i++) {
      const { name } = gl.getActiveUniform(program, i);
      this.uniforms[name] = gl.getUniformLocation(program, name);
    }
  }
}

/** Returns a texture of float32 numbers, `width` x `height` texels of four. */
function floatTexture(gl, width, height, numbers = null) {
  const texture = gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, numbers);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
  gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  return texture;
}

/** Poses of robots as uniforms: a row for each robot, two vectors for each body, and at the end the robot's index. */
class Rows {
  constructor(gl, capacity, bodies) {
    const vectors = rowVectors(bodies), buffer = gl.createBuffer();
    Object.assign(this, { gl, buffer, vectors, width: 4 * vectors, count: 0 });
    this.data = new Float32Array(capacity * this.width);
    gl.bindBuffer(gl.UNIFORM_BUFFER, buffer);
    gl.bufferData(gl.UNIFORM_BUFFER, this.data.byteLength + 16 * ROWS_VECTORS, gl.DYNAMIC_DRAW);
  }

  upload() {
    const { gl, buffer, data, count, width } = this;
    if (count === 0) return;
    gl.bindBuffer(gl.UNIFORM_BUFFER, buffer);
    gl.bufferSubData(gl.UNIFORM_BUFFER, 0, data, 0, count * width);
  }

  /** Calls a function for every few rows, which are the uniforms then, with their number. */
  each(rows, draw) {
    const { gl, buffer, count, width } = this;
    for (let first = 0; first < count; first += rows) {
      gl.bindBufferRange(gl.UNIFORM_BUFFER, 0, buffer, 4 * first * width, 16 * ROWS_VECTORS);
      draw(Math.min(rows, count - first));
    }
  }

  delete() {
    this.gl.deleteBuffer(this.buffer);
  }
}

/** Returns the vectors of a row: a multiple of 16, with which a range of uniforms may begin. */
function rowVectors(bodies) {
  return 16 * Math.ceil((2 * bodies + 1) / 16);
}

const COPIES_VERTICES = 24000;

/** A mesh on the GPU with copies for several robots. Each copy is drawn where a row of poses says. */
class Copies {
  /**
   * @param {Program} program the program that draws it
   * @param {[string, number][]} attributes names and sizes of a vertex's numbers; the last one is its body
   * @param {{vertices: number[], indices: number[]}} mesh one copy
   * @param {number} bodies the bodies of a robot
   */
  constructor(gl, program, attributes, { vertices, indices }, bodies) {
    const size = attributes.reduce((sum, [, numbers]) => sum + numbers, 0), points = vertices.length / size;
    const vectors = rowVectors(bodies), most = Math.min(64, Math.floor(ROWS_VECTORS / vectors));
    Object.assign(this, { gl, indices: indices.length });
    this.copies = Math.max(1, Math.min(most, Math.floor(COPIES_VERTICES / points)));
    const copied = new Float32Array(this.copies * vertices.length), corners = new Uint32Array(this.copies * indices.length);
    for (let copy = 0; copy < this.copies; copy++) {
      copied.set(vertices, copy * vertices.length);
      for (let at = (copy * points + 1) * size - 1, i = 0; i < points; i++, at += size)
        copied[at] = copy * vectors + 2 * copied[at];
      for (let i = 0; i < indices.length; i++) corners[copy * indices.length + i] = copy * points + indices[i];
    }
    this.layout = gl.createVertexArray();
    this.buffers = [[gl.ARRAY_BUFFER, copied], [gl.ELEMENT_ARRAY_BUFFER, corners]].map(([kind, numbers]) => {
      const buffer = gl.createBuffer();
      gl.bindVertexArray(this.layout);
      gl.bindBuffer(kind, buffer);
      gl.bufferData(kind, numbers, gl.STATIC_DRAW);
      return buffer;
    });
    let offset = 0;
    for (const [name, numbers] of attributes) {
      const at = gl.getAttribLocation(program.program, name);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, numbers, gl.FLOAT, false, 4 * size, 4 * offset);
      offset += numbers;
    }
    gl.bindVertexArray(null);
  }

  /** Draws it for each row, with the program that is in use. */
  draw(rows) {
    const { gl, copies, indices, layout } = this;
    gl.bindVertexArray(layout);
    rows.each(copies, (count) => gl.drawElements(gl.TRIANGLES, indices * count, gl.UNSIGNED_INT, 0));
  }

  delete() {
    this.gl.deleteVertexArray(this.layout);
    for (const buffer of this.buffers) this.gl.deleteBuffer(buffer);
  }
}

const BODY_ATTRIBUTES = [["position", 3], ["normal", 3], ["colour", 3], ["row", 1]];
const DECAL_ATTRIBUTES = [["box", 4], ["shape", 4], ["row", 1]];

/** Returns the mesh of flat boxes on the floor, each with its body, middle, half sizes, rounding and softness [m]. */
function decalMesh(decals) {
  const vertices = [], indices = [];
  for (const [i, { body, middle, half, round, soft }] of decals.entries()) {
    for (const [x, y] of [[-1, -1], [1, -1], [-1, 1], [1, 1]]) vertices.push(...middle, ...half, x, y, round, soft, body);
    indices.push(...[0, 1, 2, 2, 1, 3].map((corner) => 4 * i + corner));
  }
  return { vertices, indices };
}

/** Poses of all robots after the last step and before it, so that frames can show what is between two steps. */
class Motion {
  constructor(fleet, bodies) {
    this.size = bodies * 7;
    this.before = new Float32Array(fleet.poses());
    this.after = new Float32Array(this.before);
  }

  /** Takes the poses after a step. A robot that began an episode does not move between both. */
  record(fleet) {
    [this.before, this.after] = [this.after, this.before];
    const { before, after, size } = this, { done, count } = fleet;
    after.set(fleet.poses());
    for (let robot = 0; robot < count; robot++)
      if (done[robot]) before.set(after.subarray(robot * size, (robot + 1) * size), robot * size);
  }

  /** Writes a robot's poses at a share of the way between both steps into row `row`, moved by x, y [m]. */
  blend(robot, share, rows, row, x, y) {
    const { before, after, size } = this, { data } = rows;
    let to = row * rows.width;
    for (let at = robot * size; at < (robot + 1) * size; at += 7, to += 8) {
      let turn = 0;
      for (let k = 3; k < 7; k++) turn += before[at + k] * after[at + k];
      const sign = turn < 0 ? -1 : 1;
      for (let k = 0; k < 3; k++) data[to + k] = before[at + k] + share * (after[at + k] - before[at + k]);
      for (let k = 3; k < 7; k++) data[to + k + 1] = sign * before[at + k] * (1 - share) + share * after[at + k];
      data[to] += x;
      data[to + 1] += y;
      data[to + 3] = 1; // the scale
    }
    data[(row + 1) * rows.width - 4] = robot;
  }
}

/**
 * Where robots were: points of all robots, in slots of equal times that are used in turn. The newest slot follows
 * the robots until its time is over.
 */
class Trails {
  constructor(gl, program, count, dt) {
    Object.assign(this, { gl, program, count, slot: 0, steps: 0 });
    this.slots = Math.max(10, Math.min(110, Math.floor(9216 / count)));
    this.every = Math.max(1, Math.round(TRAIL_SECONDS / dt / this.slots));
    this.points = new Float32Array(4 * count);
    this.first = new Uint8Array(count).fill(1);
    this.texture = floatTexture(gl, count, this.slots, new Float32Array(4 * count * this.slots).fill(-1e9));
    const indices = new Uint32Array(6 * count * this.slots), corners = [0, 1, 2, 2, 1, 3];
    for (let i = 0; i < indices.length; i++) indices[i] = 4 * Math.floor(i / 6) + corners[i % 6];
    this.layout = gl.createVertexArray();
    gl.bindVertexArray(this.layout);
    this.buffer = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, this.buffer);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, indices, gl.STATIC_DRAW);
    gl.bindVertexArray(null);
  }

  /** Takes where the robots are after a step at a time [s]. */
  record({ after, size }, cells, done, time) {
    const { points, first, count } = this;
    for (let robot = 0; robot < count; robot++) {
      if (done[robot]) first[robot] = 1;
      const from = robot * size + 7 * ROOT;
      points[4 * robot] = after[from] + cells[2 * robot];
      points[4 * robot + 1] = after[from + 1] + cells[2 * robot + 1];
      points[4 * robot + 2] = first[robot] ? -time : time;
    }
    if (++this.steps % this.every) return;
    this.upload();
    first.fill(0);
    this.slot = (this.slot + 1) % this.slots;
  }

  upload() {
    const { gl, count, points } = this;
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, this.slot, count, 1, gl.RGBA, gl.FLOAT, points);
  }

  /** Draws the trails of the robots of some rows, with the program that is in use. */
  draw(rows) {
    const { gl, slots, program } = this;
    gl.uniform2i(program.uniforms.size, slots, rows.vectors);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    gl.bindVertexArray(this.layout);
    const most = Math.floor(ROWS_VECTORS / rows.vectors);
    rows.each(most, (count) => gl.drawElements(gl.TRIANGLES, 6 * slots * count, gl.UNSIGNED_INT, 0));
  }

  delete() {
    this.gl.deleteTexture(this.texture);
    this.gl.deleteBuffer(this.buffer);
    this.gl.deleteVertexArray(this.layout);
  }
}

/** Smooths edges by several samples of each pixel, as long as it is on. */
class Samples {
  constructor(gl) {
    Object.assign(this, { gl, on: true, width: 0, height: 0 });
    this.target = gl.createFramebuffer();
    this.buffers = [[gl.COLOR_ATTACHMENT0, gl.RGB8], [gl.DEPTH_ATTACHMENT, gl.DEPTH_COMPONENT16]].map(
      ([attachment, format]) => ({ attachment, format, buffer: gl.createRenderbuffer() }));
  }

  /** Lets everything be drawn with samples from now on. */
  begin() {
    const { gl, on, target, buffers } = this, { drawingBufferWidth: width, drawingBufferHeight: height } = gl;
    gl.bindFramebuffer(gl.FRAMEBUFFER, on ? target : null);
    if (!on || (this.width === width && this.height === height)) return;
    Object.assign(this, { width, height });
    for (const { attachment, format, buffer } of buffers) {
      gl.bindRenderbuffer(gl.RENDERBUFFER, buffer);
      gl.renderbufferStorageMultisample(gl.RENDERBUFFER, 4, format, width, height);
      gl.framebufferRenderbuffer(gl.FRAMEBUFFER, attachment, gl.RENDERBUFFER, buffer);
    }
  }

  /** Shows what was drawn. */
  end() {
    const { gl, on, target, width, height } = this;
    if (!on) return;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, target);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, width, height, gl.COLOR_BUFFER_BIT, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  }
}

/** The picture of a fleet. */
class Scene {
  /**
   * @param {HTMLCanvasElement} canvas where it is drawn
   * @param {object} meta what jetbot_mjx says of the robot
   * @throws {UnsupportedError} there is no WebGL 2
   */
  constructor(canvas, meta) {
    const gl = canvas.getContext("webgl2", { antialias: false, alpha: false });
    if (!gl) throw new UnsupportedError("This page needs WebGL 2, which this browser does not have or has turned off.");
    const { scene } = meta;
    Object.assign(this, { gl, canvas, meta, goal: scene.goal, bodies: scene.bodies, ratio: 1, showTrails: true });
    this.camera = new Camera();
    this.samples = new Samples(gl);
    this.programs = {
      body: new Program(gl, BODY_SHADER), grid: new Program(gl, GRID_SHADER),
      decal: new Program(gl, DECAL_SHADER), trail: new Program(gl, TRAIL_SHADER),
    };
    this.#measure(scene);
    this.levels = LEVELS.map((level) => ({ mesh: this.#mesh(scene, level), from: level.from, rows: null }));
    if (this.goal !== null) this.reached = this.#reachedGoal(scene);
    this.shadows = this.#shadows();
    this.empty = gl.createVertexArray();
    this.point = new Float32Array(3);
    this.marked = new Rows(gl, 1, this.bodies);
    this.rings = { soft: 0, radius: 0 };
    this.recolour();
  }

  /** Measures robot and goal. */
  #measure({ geoms, meshes }) {
    const of = (body) => geoms.filter((geom) => geom.body === body);
    this.outline = footprint(of(ROOT), meshes);
    this.radius = this.outline.radius;
    this.goalOutline = this.goal === null ? null : footprint(of(this.goal), meshes);
  }

  /** Makes the mesh of robot and goal in a level of detail. */
  #mesh({ geoms, meshes }, { sides, least }) {
    const large = ({ type, size: [a, b, c], body }) => {
      const halves = ["box", "ellipsoid", "mesh"].includes(type) ? [a, b, c] : [a, a, b];
      const [, middle, longest] = halves.sort((x, y) => x - y);
      return body === this.goal || Math.sqrt(middle * longest) >= least * this.radius;
    };
    return this.#bodies(meshOf(geoms.filter(large), meshes, sides));
  }

  #bodies(mesh) {
    return new Copies(this.gl, this.programs.body, BODY_ATTRIBUTES, mesh, this.bodies);
  }

  #reachedGoal({ geoms, meshes }) {
    const mesh = meshOf(geoms.filter((geom) => geom.body === this.goal), meshes, LEVELS[1].sides);
    return {
      mesh: this.#bodies(mesh),
      shadow: this.#decals([this.#shadow(this.goal, this.goalOutline)]),
    };
  }

  #shadow(body, { middle, half }) {
    const soft = 0.45 * Math.min(...half);
    return { body, middle, half, round: 0.2 * soft, soft };
  }

  #shadows() {
    const { goal, outline, goalOutline } = this;
    const goals = goal === null ? [] : [this.#shadow(goal, goalOutline)];
    return this.#decals([this.#shadow(ROOT, outline), ...goals]);
  }

  #decals(decals) {
    return new Copies(this.gl, this.programs.decal, DECAL_ATTRIBUTES, decalMesh(decals), this.bodies);
  }

  /** Reads the colours of the page's theme. */
  recolour() {
    const style = getComputedStyle(document.documentElement);
    this.colours = {};
    for (const name of ["floor", "line", "accent", "shadow"]) {
      const text = style.getPropertyValue(`--${name}`).trim();
      this.colours[name] = [1, 3, 5].map((at) => parseInt(text.slice(at, at + 2), 16) / 255);
    }
  }

  /** Shows another fleet, in cells of a square grid. */
  setFleet(fleet) {
    const { gl, bodies } = this, { count } = fleet, [, farthest] = this.meta.goal_range;
    const columns = Math.ceil(Math.sqrt(count)), spacing = 1.25 * farthest;
    this.fleet = fleet;
    this.side = columns * spacing;
    this.cells = new Float32Array(2 * count);
    for (let robot = 0; robot < count; robot++) {
      this.cells[2 * robot] = (Math.floor(robot / columns) - (columns - 1) / 2) * spacing;
      this.cells[2 * robot + 1] = ((robot % columns) - (columns - 1) / 2) * spacing;
    }
    this.motion = new Motion(fleet, bodies);
    for (const level of this.levels) {
      level.rows?.delete();
      level.rows = new Rows(gl, count, bodies);
    }
    this.ghosts?.delete();
    this.ghostBirths = new Float64Array(Math.min(2 * count, 256)).fill(-1e9);
    this.ghosts = new Rows(gl, this.ghostBirths.length, bodies);
    this.nextGhost = 0;
    this.clearTrails();
  }

  clearTrails() {
    this.trails?.delete();
    this.trails = new Trails(this.gl, this.programs.trail, this.fleet.count, this.meta.dt);
    this.elapsed = 1;
  }

  /** Takes what a step did. */
  record() {
    const { fleet, motion, goal } = this;
    this.elapsed += this.meta.dt;
    if (goal !== null)
      for (let robot = 0; robot < fleet.count; robot++) if (fleet.success[robot]) this.#leaveGhost(robot);
    motion.record(fleet);
    this.trails.record(motion, this.cells, fleet.done, this.elapsed);
  }

  /** Shows a robot's goal where it was moved to. */
  refreshGoal(robot) {
    if (this.goal === null) return;
    const { before, after, size } = this.motion, at = robot * size + 7 * this.goal;
    before.set(this.fleet.poses().subarray(at, at + 7), at);
    after.set(before.subarray(at, at + 7), at);
  }

  /** Returns the view in which the camera sees all robots, or those in the middle. */
  view() {
    const { camera, side } = this, free = camera.width * (1 - Math.abs(camera.shift[0]));
    const whole = (0.6 * side * camera.focal * camera.height) / free;
    const distance = Math.max(2.6, Math.min(whole, 7.5 + 0.14 * side));
    return { target: [0, 0], distance, pitch: this.fleet.count > 64 ? 0.42 : 0.62 };
  }

  /** Leaves the goal that a robot reached where it was, for a moment. */
  #leaveGhost(robot) {
    const { ghosts, cells, motion, ghostBirths } = this, slot = this.nextGhost++ % ghostBirths.length;
    motion.blend(robot, 1, ghosts, slot, cells[2 * robot], cells[2 * robot + 1]);
    ghosts.count = Math.max(ghosts.count, slot + 1);
    ghostBirths[slot] = this.elapsed;
  }

  /** Lets reached goals shrink and vanish. */
  #ageGhosts() {
    const { ghosts, ghostBirths, elapsed, goal } = this;
    for (let slot = 0; slot < ghosts.count; slot++) {
      const left = 1 - (elapsed - ghostBirths[slot]) / GHOST_SECONDS;
      ghosts.data[slot * ghosts.width + 8 * goal + 3] = Math.max(0, Math.min(1, 4 * left));
    }
    ghosts.upload();
  }

  /** Sorts the robots that can be seen into levels of detail, as they are between two steps. */
  #sort(share) {
    const { levels, fleet, motion, cells, camera, goal } = this;
    const size = (this.radius * camera.focal * camera.height) / 2; // of a robot at a depth of one metre [pixels]
    for (const level of levels) level.rows.count = 0;
    for (let robot = 0; robot < fleet.count; robot++) {
      const depth = Math.min(this.#seen(robot, ROOT), goal === null ? Infinity : this.#seen(robot, goal));
      if (depth === Infinity) continue;
      const { rows } = levels.find((level) => size >= level.from * depth);
      motion.blend(robot, share, rows, rows.count++, cells[2 * robot], cells[2 * robot + 1]);
    }
    for (const level of levels) level.rows.upload();
  }

  /** Returns the depth [m] of a robot's body; infinity: it is outside of the picture. */
  #seen(robot, body) {
    this.#locate(robot, body);
    const { point, camera } = this, x = point[0], y = point[1], depth = point[2];
    if (depth < 0) return Infinity;
    const margin = (this.radius * camera.focal * camera.height) / Math.max(depth, 0.1);
    const inside = x > -margin && x < camera.width + margin && y > -margin && y < camera.height + margin;
    return inside ? depth : Infinity;
  }

  /** Writes where a robot's body is seen into `point`. */
  #locate(robot, body) {
    const { motion, cells, camera, point } = this, at = robot * motion.size + 7 * body, { after } = motion;
    camera.project(after[at] + cells[2 * robot], after[at + 1] + cells[2 * robot + 1], after[at + 2], point);
  }

  /** Returns `{robot, goal}` for what is seen near a pixel (whether it is the goal); null: nothing. */
  pick(px, py, reach = 16) {
    let found = null, nearest = Infinity;
    for (let robot = 0; robot < this.fleet.count; robot++)
      for (const body of this.goal === null ? [ROOT] : [ROOT, this.goal]) {
        this.#locate(robot, body);
        const [x, y, depth] = this.point, away = Math.hypot(x - px, y - py);
        const size = (0.6 * this.radius * this.camera.focal * this.camera.height) / depth / 2;
        if (depth < 0 || away > Math.max(reach, size) || away / Math.max(reach, size) >= nearest) continue;
        nearest = away / Math.max(reach, size);
        found = { robot, goal: body === this.goal };
      }
    return found;
  }

  /** Returns x, y [m] in a robot's own frame of the floor under a pixel; null: there is none. */
  place(robot, px, py, z = 0) {
    const at = this.camera.floorAt(px, py, z);
    return at && [at[0] - this.cells[2 * robot], at[1] - this.cells[2 * robot + 1]];
  }

  /** Fits the drawing buffer to the canvas. */
  resize() {
    const { canvas, gl, camera, ratio } = this, { clientWidth, clientHeight } = canvas;
    const width = Math.max(1, Math.round(clientWidth * ratio)), height = Math.max(1, Math.round(clientHeight * ratio));
    [camera.width, camera.height] = [clientWidth || 1, clientHeight || 1];
    if (canvas.width === width && canvas.height === height) return;
    [canvas.width, canvas.height] = [width, height];
    gl.viewport(0, 0, width, height);
  }

  /**
   * Draws a frame.
   * @param {number} share how much of the way from the step before to the last one has passed, 0 to 1
   * @param {number} chosen the robot that is marked
   */
  draw(share, chosen) {
    const { gl, camera, colours, samples } = this;
    this.resize();
    camera.update();
    this.#sort(share);
    if (this.goal !== null) this.#ageGhosts();
    samples.begin();
    gl.clearColor(...colours.floor, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.disable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    this.#drawGrid();
    this.#drawShadows();
    this.#drawMarks(chosen, share);
    if (this.showTrails) this.#drawTrails();
    gl.disable(gl.BLEND);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.CULL_FACE);
    this.#drawBodies();
    gl.disable(gl.CULL_FACE);
    samples.end();
  }

  #use(name) {
    const program = this.programs[name];
    this.gl.useProgram(program.program);
    this.gl.uniformMatrix4fv(program.uniforms.view, false, this.camera.matrix);
    return program.uniforms;
  }

  #drawGrid() {
    const { gl, camera, colours } = this, uniforms = this.#use("grid"), { target, distance, eye } = camera;
    gl.uniform4f(uniforms.area, target[0], target[1], Math.max(7, 4 * distance), this.#metresOfPixel());
    gl.uniform3fv(uniforms.eye, eye);
    gl.uniform3fv(uniforms.tint, colours.line);
    gl.bindVertexArray(this.empty);
    gl.drawArrays(gl.TRIANGLES, 0, 2 * GRID_LINES * GRID_PARTS * 6);
  }

  /** Draws soft shadows of robots and goals, but for the smallest. */
  #drawShadows() {
    const { gl, levels, ghosts, reached } = this, uniforms = this.#use("decal");
    gl.uniform1f(uniforms.ring, 0);
    gl.uniform4f(uniforms.tint, ...this.colours.shadow, 0.5);
    for (const { rows, from } of levels) if (from) this.shadows.draw(rows);
    if (reached) reached.shadow.draw(ghosts);
  }

  /** Draws a ring around the chosen robot, and one where its goal counts as reached. */
  #drawMarks(chosen, share) {
    const { gl, marked, motion, cells, camera, colours } = this, uniforms = this.#use("decal");
    motion.blend(chosen, share, marked, 0, cells[2 * chosen], cells[2 * chosen + 1]);
    marked.count = 1;
    marked.upload();
    const soft = Math.max(0.006, 1.2 * this.#metresOfPixel() * camera.distance);
    this.#prepareMarks(soft, this.fleet.knobs.successRadius);
    gl.uniform1f(uniforms.ring, 1);
    gl.uniform4f(uniforms.tint, ...colours.accent, 0.8);
    this.marks.draw(marked);
  }

  /** Makes the rings again where their width or radius has changed. */
  #prepareMarks(soft, radius) {
    const { goal, outline, rings: last } = this;
    if (last.soft === soft && last.radius === radius) return;
    Object.assign(last, { soft, radius });
    const ring = { half: [0, 0], soft }, around = 1.35 * Math.hypot(...outline.half);
    const rings = [{ ...ring, body: ROOT, middle: outline.middle, round: around }];
    if (goal !== null) rings.push({ ...ring, body: goal, middle: [0, 0], round: radius });
    this.marks?.delete();
    this.marks = this.#decals(rings);
  }

  /** Returns the metres of a pixel at a depth of one metre. */
  #metresOfPixel() {
    return 2 / (this.camera.focal * this.camera.height);
  }

  /** Draws the trails, but for those of the smallest robots. */
  #drawTrails() {
    const { gl, trails, levels } = this, uniforms = this.#use("trail");
    gl.uniform3f(uniforms.look, this.elapsed, TRAIL_SECONDS, 0.6 * this.#metresOfPixel());
    gl.uniform4f(uniforms.tint, ...this.colours.accent, 0.75);
    trails.upload();
    for (const { rows, from } of levels) if (from) trails.draw(rows);
  }

  #drawBodies() {
    const { gl, ghosts, levels, reached } = this, uniforms = this.#use("body");
    gl.uniform3fv(uniforms.sun, SUN);
    gl.uniform4f(uniforms.green, ...GOAL_GREEN, 0);
    for (const { mesh, rows } of levels) mesh.draw(rows);
    gl.uniform4f(uniforms.green, ...GOAL_GREEN, 1);
    if (reached) reached.mesh.draw(ghosts);
  }
}
