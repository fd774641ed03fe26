//! `maille`: the command. Reads the command line and hands over to one file a subcommand in [`commands`].

mod commands;

use clap::{Parser, Subcommand};
use maille_realtime::CountingAllocator;
use std::process::ExitCode;

/// Counts allocations, so that the 1 kHz loop can prove that it makes none; one thread-local addition a call.
#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Surgery simulated by touch on a patient's own CT, without making a mesh.
///
/// Without a subcommand the default scene runs: a made patient, a scripted endoscope, and a page on 127.0.0.1.
#[derive(Parser)]
#[command(name = "maille", version, propagate_version = true, max_term_width = 110)]
struct CommandLine {
    #[command(subcommand)]
    command: Option<Command>,
}

#[derive(Subcommand)]
enum Command {
    Run(commands::run::Args),
    Service(commands::service::Args),
    Check(commands::check::Args),
    Info(commands::info::Args),
    Import(commands::import::Args),
    Deform(commands::deform::Args),
    Invert(commands::invert::Args),
    Motion(commands::motion::Args),
    Render(commands::render::Args),
    Surface(commands::surface::Args),
    Latency(commands::latency::Args),
    Tradeoff(commands::tradeoff::Args),
    Effects(commands::effects::Args),
    #[command(hide = true)]
    LatencyHelper(commands::latency::HelperArgs),
    #[command(hide = true)]
    VetDevice(commands::vet::Args),
    #[command(hide = true)]
    Turns(commands::turns::Args),
    Doctor(commands::doctor::Args),
    Clean(commands::clean::Args),
}

/// Who reads may stop reading (`maille info FILE | head`): the command ends there, as others do when told so by a signal, and says nothing.
fn end_with_the_reader() {
    let usual = std::panic::take_hook();
    std::panic::set_hook(Box::new(move |info| {
        let said = info.payload().downcast_ref::<String>();
        if said.is_some_and(|said| said.starts_with("failed printing to stdout") && said.contains("Broken pipe")) {
            std::process::exit(141);
        }
        usual(info);
    }));
}

fn main() -> ExitCode {
    end_with_the_reader();
    let command = CommandLine::parse().command.unwrap_or_else(|| Command::Run(commands::run::Args::default()));
    let outcome = match command {
        Command::Run(args) => commands::run::run(&args),
        Command::Service(args) => commands::service::run(&args),
        Command::Check(args) => commands::check::run(&args),
        Command::Info(args) => commands::info::run(&args),
        Command::Import(args) => commands::import::run(&args),
        Command::Deform(args) => commands::deform::run(&args),
        Command::Invert(args) => commands::invert::run(&args),
        Command::Motion(args) => commands::motion::run(&args),
        Command::Render(args) => commands::render::run(&args),
        Command::Surface(args) => commands::surface::run(&args),
        Command::Latency(args) => commands::latency::run(&args),
        Command::Tradeoff(args) => commands::tradeoff::run(&args),
        Command::Effects(args) => commands::effects::run(&args),
        Command::LatencyHelper(args) => commands::latency::help(&args),
        Command::VetDevice(args) => commands::vet::run(&args),
        Command::Turns(args) => commands::turns::run(&args),
        Command::Doctor(args) => commands::doctor::run(&args),
        Command::Clean(args) => commands::clean::run(&args),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            eprintln!("{failure}");
            ExitCode::from(failure.status())
        }
    }
}
