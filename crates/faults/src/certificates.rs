//! Certificates, good and bad, made for a test.

use rcgen::{BasicConstraints, CertificateParams, DistinguishedName, DnType, IsCa, Issuer, KeyPair, date_time_ymd};
use std::path::{Path, PathBuf};

const MADE: &str = "a certificate";

/// An authority.
pub struct Authority {
    issuer: Issuer<'static, KeyPair>,
    pem: String,
}

/// A certificate's and a key's file.
pub struct Pair {
    /// The certificate, PEM.
    pub cert: PathBuf,
    /// Its private key, PEM.
    pub key: PathBuf,
}

impl Authority {
    /// One of this name, which is no other one's of the same name.
    ///
    /// # Panics
    /// As all here, where a certificate or a file cannot be made.
    pub fn new(name: &str) -> Self {
        let mut params = CertificateParams::new(Vec::new()).expect(MADE);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name = DistinguishedName::new();
        params.distinguished_name.push(DnType::CommonName, name);
        let key = KeyPair::generate().expect(MADE);
        let pem = params.self_signed(&key).expect(MADE).pem();
        Self { issuer: Issuer::new(params, key), pem }
    }

    /// The file of its own certificate.
    pub fn file(&self, directory: &Path, name: &str) -> PathBuf {
        let path = directory.join(name);
        std::fs::write(&path, &self.pem).expect(MADE);
        path
    }

    /// Files of a certificate for these names, good from 2020 until that year, written over what was there.
    pub fn issue(&self, directory: &Path, file: &str, names: &[&str], until_year: i32) -> Pair {
        let mut params =
            CertificateParams::new(names.iter().map(|name| (*name).to_owned()).collect::<Vec<_>>()).expect(MADE);
        (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(until_year, 1, 1));
        let own = KeyPair::generate().expect(MADE);
        let pair = Pair { cert: directory.join(format!("{file}.pem")), key: directory.join(format!("{file}.key")) };
        std::fs::write(&pair.cert, params.signed_by(&own, &self.issuer).expect(MADE).pem()).expect(MADE);
        std::fs::write(&pair.key, own.serialize_pem()).expect(MADE);
        pair
    }
}
