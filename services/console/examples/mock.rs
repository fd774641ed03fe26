//! The page over a made run: `cargo run -p maille-console --example mock [PORT]`. For working on the page without voxels, shared
//! memory or other processes.

#[path = "../tests/mock/mod.rs"]
mod mock;

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let port = std::env::args().nth(1).map_or(Ok(0), |p| p.parse())?;
    let (listener, port) = maille_console::listen(port)?;
    println!("console      http://127.0.0.1:{port}/");
    Ok(maille_console::serve(mock::Mock::new(Default::default(), 640), listener, 85)?)
}
