//! `perturb serve`: starts the live web page.

use std::io::Write;

use super::args::ServeArgs;
use super::display::{note, output, say};
use super::error::{Result, system};
use perturb_serve::{ServeOptions, Server};

pub(super) fn run(args: &ServeArgs) -> Result<()> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
    let runtime = runtime.map_err(system("wait for requests"))?;
    let (folder, hosts, server) = (args.dir.clone(), args.host.clone(), args.server.clone());
    let options = ServeOptions { folder, address: args.address, hosts, server };
    runtime.block_on(async {
        let server = Server::bind(&options).await?;
        let address = server.address();
        if !address.ip().is_loopback() {
            let warning = "there is no authentication and no encryption: everybody who reaches this address can see \
                           the whole folder, and so can any web site that they open; prefer 127.0.0.1 and `ssh -L`";
            say(format_args!("perturb: {warning}"));
        }
        let mut out = output();
        writeln!(out, "http://{address}")?;
        out.flush()?;
        note(format_args!("serving {}; Ctrl-C stops it", args.dir.display()));
        match server.run().await {}
    })
}
