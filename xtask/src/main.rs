//! Gates as tests, golden parity, interop with other people's software.
fn main() {}
