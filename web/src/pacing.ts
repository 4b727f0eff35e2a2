// Keeps a slow GPU from blocking the page.
//
// Spark sorts by what it reads back from the GPU, and `getBufferSubData` returns only when all that was queued before it is done, drawings behind the read
// among it. Where the GPU takes long for a drawing (software rendering, a million splats on a small device), nothing is queued while the last drawing runs
// or an order is awaited, and a read counts as ready only when nothing is queued: then it returns at once.

/// A drawing that takes longer makes the GPU a slow one.
const SLOW_MS = 50;
/// An order that takes longer is not waited for.
const PATIENCE_MS = 3000;

export class Pacing {
  private fence: WebGLSync | null = null;
  private began = 0;
  /// Until the first drawing is timed.
  private isSlow = true;
  private readonly wait: WebGL2RenderingContext["clientWaitSync"];

  constructor(private readonly gl: WebGL2RenderingContext) {
    this.wait = gl.clientWaitSync.bind(gl);
    gl.clientWaitSync = (sync, flags, timeout) => {
      const found = this.wait(sync, flags, timeout);
      const isBusy = this.isSlow && !this.isIdle() && !this.isLate();
      return isBusy && found !== gl.WAIT_FAILED ? gl.TIMEOUT_EXPIRED : found;
    };
  }

  /// Whether the next drawing should wait.
  isHolding(isSorting: boolean): boolean {
    const isIdle = this.isIdle();
    return this.isSlow && (!isIdle || isSorting) && !this.isLate();
  }

  /// A drawing has been queued.
  drew(): void {
    if (this.fence) {
      this.gl.deleteSync(this.fence);
    }
    this.fence = this.gl.fenceSync(this.gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.gl.flush();
    this.began = performance.now();
  }

  private isLate(): boolean {
    return this.fence === null && performance.now() - this.began > PATIENCE_MS;
  }

  private isIdle(): boolean {
    if (this.fence === null) {
      return true;
    }
    if (this.wait(this.fence, 0, 0) === this.gl.TIMEOUT_EXPIRED) {
      return false;
    }
    this.isSlow = performance.now() - this.began > SLOW_MS;
    this.gl.deleteSync(this.fence);
    this.fence = null;
    return true;
  }
}
