use std::sync::OnceLock;
pub(super) fn on(name: &str) -> bool {
    static ON: OnceLock<String> = OnceLock::new();
    ON.get_or_init(|| std::env::var("SM_AB").unwrap_or_default())
        .contains(name)
}
