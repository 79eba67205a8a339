//! One test alone: the limit is the whole process's.

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
    setrlimit(Resource::Fsize, before).unwrap(); // what the test prints may go to a file
    let [within, beyond] = writes;
    assert_eq!(within.unwrap(), 4);
    assert_eq!(beyond.unwrap_err().kind(), ErrorKind::FileTooLarge);
}
