//! The program with which libFuzzer runs `perturb_fuzz::ledgers`.
#![no_main]
libfuzzer_sys::fuzz_target!(|data: &[u8]| perturb_fuzz::ledgers(data));
