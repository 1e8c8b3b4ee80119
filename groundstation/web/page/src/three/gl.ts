/** The little linear algebra and WebGL that the 3-D view needs. Matrices are column-major, as WebGL takes them. */

export type Matrix = Float32Array;
export type Vector = [number, number, number];

export function multiply(a: Matrix, b: Matrix): Matrix {
  const out = new Float32Array(16);
  for (let column = 0; column < 4; column++)
    for (let row = 0; row < 4; row++)
      for (let k = 0; k < 4; k++) out[4 * column + row]! += a[4 * k + row]! * b[4 * column + k]!;
  return out;
}

export function perspective(fovRad: number, aspect: number, near: number, far: number): Matrix {
  const f = 1 / Math.tan(fovRad / 2);
  return new Float32Array([f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / (near - far), -1, 0, 0, (2 * far * near) / (near - far), 0]);
}

const minus = (a: Vector, b: Vector): Vector => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const cross = (a: Vector, b: Vector): Vector => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const dot = (a: Vector, b: Vector) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
function unit(a: Vector): Vector {
  const length = Math.sqrt(dot(a, a)) || 1;
  return [a[0] / length, a[1] / length, a[2] / length];
}

export function lookAt(eye: Vector, at: Vector, up: Vector): Matrix {
  const back = unit(minus(eye, at));
  const right = unit(cross(up, back));
  const above = cross(back, right);
  return new Float32Array([
    right[0], above[0], back[0], 0, right[1], above[1], back[1], 0, right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ]);
}

/** Where a point lands: [x, y] from -1 to 1, and whether it is in front of the eye. */
export function project(m: Matrix, p: Vector): [number, number, boolean] {
  const at = (row: number) => m[row]! * p[0] + m[4 + row]! * p[1] + m[8 + row]! * p[2] + m[12 + row]!;
  const w = at(3);
  return [at(0) / w, at(1) / w, w > 0];
}

const VERTEX = `#version 300 es
in vec3 place; uniform mat4 view; uniform vec3 at; uniform float size; uniform vec2 turn; out vec3 normal;
void main() {
  vec3 p = vec3(turn.x * place.x - turn.y * place.y, turn.y * place.x + turn.x * place.y, place.z);
  normal = p;
  gl_Position = view * vec4(at + size * p, 1.0);
}`;

const FRAGMENT = `#version 300 es
precision mediump float; in vec3 normal; uniform vec4 colour; uniform float shaded; out vec4 seen;
void main() {
  float light = mix(1.0, 0.55 + 0.45 * clamp(dot(normalize(normal), normalize(vec3(0.3, -0.4, -0.9))), -0.6, 1.0), shaded);
  seen = vec4(colour.rgb * light, colour.a);
}`;

export class Gl {
  private readonly gl: WebGL2RenderingContext;
  private readonly program: WebGLProgram;
  private readonly places = new Map<string, WebGLUniformLocation | null>();
  private readonly kept = new Map<object, WebGLBuffer>();
  private readonly scratch: WebGLBuffer;

  constructor(canvas: HTMLCanvasElement) {
    const gl = canvas.getContext("webgl2", { antialias: true });
    if (gl === null) throw new Error("this browser has no WebGL 2");
    this.gl = gl;
    this.program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]] as const) {
      const shader = gl.createShader(kind)!;
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(this.program, shader);
    }
    gl.bindAttribLocation(this.program, 0, "place");
    gl.linkProgram(this.program);
    this.scratch = gl.createBuffer();
    gl.enableVertexAttribArray(0);
    gl.enable(gl.DEPTH_TEST);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  begin(width: number, height: number, background: number[], view: Matrix): void {
    const gl = this.gl;
    gl.viewport(0, 0, width, height);
    gl.clearColor(background[0]!, background[1]!, background[2]!, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    gl.useProgram(this.program);
    gl.uniformMatrix4fv(this.at("view"), false, view);
  }

  private at(name: string): WebGLUniformLocation | null {
    if (!this.places.has(name)) this.places.set(name, this.gl.getUniformLocation(this.program, name));
    return this.places.get(name)!;
  }

  private draw(mode: number, points: Float32Array, colour: number[], at: Vector, size: number, yaw: number, shaded: boolean, keep: boolean): void {
    const gl = this.gl;
    let buffer = keep ? this.kept.get(points) : this.scratch;
    const fresh = buffer === undefined || !keep;
    if (buffer === undefined) this.kept.set(points, (buffer = gl.createBuffer()));
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    if (fresh) gl.bufferData(gl.ARRAY_BUFFER, points, keep ? gl.STATIC_DRAW : gl.STREAM_DRAW);
    gl.vertexAttribPointer(0, 3, gl.FLOAT, false, 0, 0);
    gl.uniform3fv(this.at("at"), at);
    gl.uniform1f(this.at("size"), size);
    gl.uniform2f(this.at("turn"), Math.cos(yaw), Math.sin(yaw));
    gl.uniform4fv(this.at("colour"), colour);
    gl.uniform1f(this.at("shaded"), shaded ? 1 : 0);
    gl.drawArrays(mode, 0, points.length / 3);
  }

  line(points: Float32Array, colour: number[]): void {
    if (points.length >= 6) this.draw(this.gl.LINE_STRIP, points, colour, [0, 0, 0], 1, 0, false, false);
  }

  segments(points: Float32Array, colour: number[]): void {
    this.draw(this.gl.LINES, points, colour, [0, 0, 0], 1, 0, false, false);
  }

  /** A shape that stays the same, placed, scaled and turned. */
  solid(points: Float32Array, colour: number[], at: Vector, size: number, yaw: number): void {
    this.draw(this.gl.TRIANGLES, points, colour, at, size, yaw, true, true);
  }

  /** Something that one looks through: it hides nothing behind it. */
  pane(points: Float32Array, colour: number[]): void {
    this.gl.depthMask(false);
    this.draw(this.gl.TRIANGLES, points, colour, [0, 0, 0], 1, 0, false, false);
    this.gl.depthMask(true);
  }

  lose(): void {
    this.gl.getExtension("WEBGL_lose_context")?.loseContext();
  }
}

/** A ball of radius 1 as triangles. */
export function ball(rings: number, around: number): Float32Array {
  const at = (i: number, j: number): Vector => {
    const [a, b] = [(Math.PI * i) / rings, (2 * Math.PI * j) / around];
    return [Math.sin(a) * Math.cos(b), Math.sin(a) * Math.sin(b), Math.cos(a)];
  };
  const out: number[] = [];
  for (let i = 0; i < rings; i++)
    for (let j = 0; j < around; j++)
      for (const p of [at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j), at(i + 1, j + 1), at(i, j + 1)]) out.push(...p);
  return new Float32Array(out);
}

/** A cone ahead of a ball of radius 1: where it heads. */
export function nose(around: number): Float32Array {
  const out: number[] = [];
  for (let j = 0; j < around; j++) {
    const rim = (k: number): Vector => [0.85, 0.45 * Math.cos((2 * Math.PI * k) / around), 0.45 * Math.sin((2 * Math.PI * k) / around)];
    out.push(1.6, 0, 0, ...rim(j), ...rim(j + 1));
  }
  return new Float32Array(out);
}
