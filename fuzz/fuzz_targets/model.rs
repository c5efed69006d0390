#![no_main]

use libfuzzer_sys::fuzz_target;

fuzz_target!(|bytes: &[u8]| stokescope_fuzz::model(
    std::path::Path::new(&std::env::var_os("STOKESCOPE").expect("STOKESCOPE names the program")),
    bytes
));
