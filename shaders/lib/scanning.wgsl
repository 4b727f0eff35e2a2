// Exclusive prefix sum in three stages: how numbers are shared out.

const SCAN_THREADS: u32 = 256u;
// Numbers that one thread takes.
const SCAN_PER_THREAD: u32 = 8u;
const SCAN_BLOCK: u32 = SCAN_THREADS * SCAN_PER_THREAD;

var<workgroup> partial: array<u32, 512>;

// The sum of the values of all threads before this one (Hillis and Steele 1986).
fn sum_before(lane: u32, value: u32) -> u32 {
    var from_half = 0u;
    partial[lane] = value;
    workgroupBarrier();
    for (var reach = 1u; reach < SCAN_THREADS; reach *= 2u) {
        var sum = partial[from_half + lane];
        if lane >= reach {
            sum += partial[from_half + lane - reach];
        }
        from_half = SCAN_THREADS - from_half;
        partial[from_half + lane] = sum;
        workgroupBarrier();
    }
    return partial[from_half + lane] - value;
}
