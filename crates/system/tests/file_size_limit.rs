//! Tests [`ignore_sigxfsz`] in a process of its own, because the limit of file sizes applies to the whole process.

use std::io::{ErrorKind, Write};

use perturb_system::ignore_sigxfsz;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};

#[test]
fn a_write_beyond_the_limit_of_file_sizes_fails() {
    ignore_sigxfsz().unwrap();
    let mut file = tempfile::tempfile().unwrap();
    let before = getrlimit(Resource::Fsize);
    setrlimit(Resource::Fsize, Rlimit { current: Some(4), ..before }).unwrap();
    let writes = [b"123456", b"567890"].map(|text| file.write(text));
    setrlimit(Resource::Fsize, before).unwrap(); // restored, because the test's output may go to a file
    let [within, beyond] = writes;
    assert_eq!(within.unwrap(), 4);
    assert_eq!(beyond.unwrap_err().kind(), ErrorKind::FileTooLarge);
}
