//! Linker options of the programs.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    // The engine's tables hold tens of thousands of addresses, 24 bytes for each in the file and in memory; packed, next to
    // nothing. Needs glibc 2.36 (Debian 12, Raspberry Pi OS 12); a linker that cannot do it says so and goes on.
    let target = |key: &str| std::env::var(format!("CARGO_CFG_TARGET_{key}")).unwrap_or_default();
    if target("OS") == "linux" && target("ENV") == "gnu" {
        println!("cargo:rustc-link-arg-bins=-Wl,-z,pack-relative-relocs");
    }
}
