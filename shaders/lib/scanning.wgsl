// Exclusive prefix sum in three stages: how numbers are shared out.

const SCAN_THREADS: u32 = 64u;
// Neighbouring numbers that one thread takes.
const SCAN_PER_THREAD: u32 = 32u;
const SCAN_BLOCK: u32 = SCAN_THREADS * SCAN_PER_THREAD;
