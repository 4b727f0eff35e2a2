//! Which threads give way when processors are few.

/// Raises the niceness of the calling thread to `niceness`, 0 to 19: the system gives it less time beside others. Needs no
/// rights. On Linux only; elsewhere threads stay equal.
pub fn lower_this_thread(niceness: i32) {
    #[cfg(target_os = "linux")]
    {
        // Linux takes the id of a thread for that of a process here, and then means the thread alone: setpriority(2), notes.
        let thread = rustix::thread::gettid();
        if let Err(e) = rustix::process::setpriority_process(Some(thread), niceness) {
            tracing::debug!("a thread keeps its priority: {e}");
        }
    }
    #[cfg(not(target_os = "linux"))]
    let _ = niceness;
}

#[cfg(test)]
mod tests {
    #[cfg(target_os = "linux")]
    #[test]
    fn one_thread_gives_way_and_the_others_do_not() {
        let niceness = || {
            let thread = rustix::thread::gettid();
            rustix::process::getpriority_process(Some(thread)).expect("readable")
        };
        let before = niceness();
        let builder = std::thread::Builder::new().name("lowered".to_owned());
        let lowered = builder.spawn(move || {
            super::lower_this_thread(before + 3);
            niceness()
        });
        let lowered = lowered.expect("starts").join().expect("ends");
        assert_eq!(lowered, before + 3);
        assert_eq!(niceness(), before);
    }
}
