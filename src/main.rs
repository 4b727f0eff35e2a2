fn main() -> std::process::ExitCode {
    splat_mapper::cli::main()
}
