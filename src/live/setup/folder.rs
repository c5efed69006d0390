//! The bundle that the setup makes, in a folder beside the board's until it is complete.

use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

use parking_lot::Mutex;

use crate::Error;
use crate::board::Readout;
use crate::bundle::{Bundle, BundleError, DESCRIPTION, Draft};
use crate::config::{self, ConfigError};
use crate::files::{WriteError, write_atomic};
use stokescope_core::calibrate::Step;

/// A bundle in the making. The board's folder is replaced as a whole by [`Workspace::finish`].
#[derive(Debug)]
pub(in crate::live) struct Workspace {
    /// Folder of the board's bundle.
    pub(in crate::live) dir: PathBuf,
    work: PathBuf,
    previous: PathBuf,
    readout: Option<Readout>,
    mounted: Option<u32>,
    parts: Mutex<Parts>,
}

/// The parts of a bundle that are there.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(in crate::live) struct Parts {
    /// Steps whose results the bundle holds, in the order of [`STEPS`].
    kept: [bool; STEPS.len()],
    /// Count without light, once the dark frame is known.
    black: Option<f32>,
}

/// The steps in their usual order.
pub(in crate::live) const STEPS: [Step; 6] =
    [Step::Dark, Step::Mask, Step::Psf, Step::White, Step::Align, Step::Verify];

/// Place of a step in [`STEPS`].
pub(in crate::live) const fn place(step: Step) -> usize {
    match step {
        Step::Dark => 0,
        Step::Mask => 1,
        Step::Psf => 2,
        Step::White => 3,
        Step::Align => 4,
        Step::Verify => 5,
    }
}

impl Parts {
    fn of(draft: &Draft) -> Self {
        let has = |step| match step {
            Step::Dark => draft.known.sensor.is_some() && draft.known.noise.is_some(),
            Step::Mask => draft.has("mask", "kind"),
            Step::Psf => draft.has("psf", "file"),
            Step::White => draft.has("white", "gains"),
            Step::Align => draft.has("guide", "homography"),
            Step::Verify => false,
        };
        Self { kept: STEPS.map(has), black: draft.known.sensor.map(|sensor| sensor.black_level) }
    }

    /// Whether the bundle holds the result of a step.
    pub(in crate::live) fn has(self, step: Step) -> bool {
        self.kept[place(step)]
    }

    /// Count without light, once the dark frame is known.
    pub(in crate::live) fn black(self) -> Option<f32> {
        self.black
    }

    /// Steps without which the bundle cannot be used.
    pub(in crate::live) fn missing(self) -> impl Iterator<Item = Step> {
        [Step::Dark, Step::Mask, Step::Psf].into_iter().filter(move |step| !self.has(*step))
    }
}

impl Workspace {
    /// Goes on with the bundle in the making beside `dir`, if there is one, or begins with the one in `dir`. Nothing is written yet.
    /// `readout` is the part of the frames that a new bundle uses, `mounted` the rotation of its sensor.
    ///
    /// # Errors
    /// A bundle that cannot be read, or a folder without a name.
    pub(in crate::live) fn open(dir: &Path, readout: Option<Readout>, mounted: Option<u32>) -> Result<Self, Error> {
        let Some(name) = dir.file_name().map(|name| name.to_string_lossy().into_owned()) else {
            return Err(Error::Usage(format!("{}: cannot hold a bundle: name a folder", dir.display())));
        };
        let beside = |end: &str| dir.with_file_name(format!("{name}.{end}"));
        let (work, previous) = (beside("setup"), beside("previous"));
        // a replacement that was interrupted left neither the old nor the new bundle in place
        if !dir.exists() && !work.exists() && previous.exists() {
            fs::rename(&previous, dir).map_err(|source| WriteError::Create { path: dir.to_path_buf(), source })?;
        }
        let own = Self { dir: dir.to_path_buf(), work, previous, readout, mounted, parts: Mutex::default() };
        *own.parts.lock() = Parts::of(&own.draft()?);
        Ok(own)
    }

    /// Folder of the bundle in the making.
    pub(in crate::live) fn work(&self) -> &Path {
        &self.work
    }

    /// The parts that are there.
    pub(in crate::live) fn parts(&self) -> Parts {
        *self.parts.lock()
    }

    /// Folder that holds the latest description: that of the bundle in the making, or the board's.
    fn current(&self) -> &Path {
        if self.work.join(DESCRIPTION).exists() { &self.work } else { &self.dir }
    }

    /// Rotation of the sensor that the bundle is for.
    pub(in crate::live) fn orientation(&self) -> Result<Option<u32>, BundleError> {
        Ok(Bundle::orientation_in(self.current())?.or(self.mounted))
    }

    /// The bundle in the making, to be measured against.
    pub(in crate::live) fn draft(&self) -> Result<Draft, BundleError> {
        Draft::open(self.current())
    }

    /// The bundle in the making, where it is complete.
    pub(in crate::live) fn bundle(&self) -> Result<Bundle, BundleError> {
        Bundle::load(self.current())
    }

    /// Picture of a step's result.
    pub(in crate::live) fn picture(&self, step: Step) -> PathBuf {
        self.current().join(format!("{step}.png"))
    }

    /// Changes the bundle in the making.
    ///
    /// # Errors
    /// Those of `change`, and a folder that cannot be written.
    pub(in crate::live) fn change(&self, change: impl FnOnce(&mut Draft) -> Result<(), Error>) -> Result<(), Error> {
        self.begin()?;
        let mut draft = Draft::open(&self.work)?;
        if draft.known.sensor.is_none() {
            draft.use_part(self.readout.map(|readout| readout.window).as_ref(), self.mounted)?;
        }
        change(&mut draft)?;
        draft.commit()?;
        *self.parts.lock() = Parts::of(&Draft::open(&self.work)?);
        Ok(())
    }

    /// Makes the folder, with the files of the board's bundle where there is one. The description comes last.
    fn begin(&self) -> Result<(), Error> {
        if self.work.join(DESCRIPTION).exists() {
            return Ok(());
        }
        let create = |path: &Path| {
            let path = path.to_path_buf();
            move |source| WriteError::Create { path, source }
        };
        fs::create_dir_all(&self.work).map_err(create(&self.work))?;
        let text = match config::read(&self.dir.join(DESCRIPTION)) {
            Ok(text) => text,
            Err(ConfigError::Missing(_)) => {
                let name = self.dir.file_name().unwrap_or_default().to_string_lossy();
                format!("version = 1\nname = {}\n", toml::Value::from(name.into_owned()))
            }
            Err(e) => return Err(e.into()),
        };
        for entry in fs::read_dir(&self.dir).into_iter().flatten().flatten() {
            let (name, is_file) = (entry.file_name(), entry.file_type().is_ok_and(|kind| kind.is_file()));
            if is_file && name != DESCRIPTION {
                let to = self.work.join(name);
                // its contents must be on the disk before the folder takes the place of the board's
                fs::copy(entry.path(), &to).and_then(|_| File::open(&to)?.sync_all()).map_err(create(&to))?;
            }
        }
        write_atomic(&self.work.join(DESCRIPTION), |out| out.write_all(text.as_bytes()))?;
        Ok(())
    }

    /// Puts the complete bundle in the place of the board's, which stays beside it under the name of an earlier one.
    ///
    /// # Errors
    /// A bundle that is not complete, or folders that cannot be renamed; the board's folder is then as it was.
    pub(in crate::live) fn finish(&self) -> Result<Bundle, Error> {
        let bundle = self.bundle()?;
        if self.current() == self.dir {
            return Ok(bundle);
        }
        let refuse = |source| WriteError::Create { path: self.dir.clone(), source };
        if self.previous.exists() {
            fs::remove_dir_all(&self.previous).map_err(refuse)?;
        }
        self.replace().map_err(refuse)?;
        // the renames survive a power cut only after the folder is flushed; a system that cannot flush it does what it can
        drop(File::open(parent(&self.dir)).and_then(|folder| folder.sync_all()));
        Ok(Bundle::load(&self.dir)?)
    }

    /// Renames the folders. The two bundles change places in one step, so that a power cut leaves one of them there, where the file system can
    /// do that.
    fn replace(&self) -> io::Result<()> {
        if !self.dir.exists() {
            return fs::rename(&self.work, &self.dir);
        }
        fs::rename(&self.work, &self.previous)?;
        if exchange(&self.previous, &self.dir).is_ok() {
            return Ok(());
        }
        fs::rename(&self.previous, &self.work)?;
        fs::rename(&self.dir, &self.previous)?;
        // without the old bundle in place the board has none at all
        fs::rename(&self.work, &self.dir).inspect_err(|_| drop(fs::rename(&self.previous, &self.dir)))
    }
}

/// Folder that contains `dir`.
fn parent(dir: &Path) -> &Path {
    dir.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Lets two folders change their names in one step.
///
/// # Errors
/// When the system or the file system cannot do that, or refuses.
fn exchange(one: &Path, other: &Path) -> io::Result<()> {
    #[cfg(target_os = "linux")]
    {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        Ok(renameat_with(CWD, one, CWD, other, RenameFlags::EXCHANGE)?)
    }
    #[cfg(not(target_os = "linux"))]
    {
        let _ = (one, other);
        Err(io::ErrorKind::Unsupported.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use stokescope_core::image::{Size, Window};

    fn fill(draft: &mut Draft) -> Result<(), Error> {
        for (key, value) in [("width", 16), ("height", 16), ("channels", 1)] {
            draft.set("sensor", key, value);
        }
        draft.set("noise", "read", 0.002);
        Ok(())
    }

    fn complete(draft: &mut Draft) -> Result<(), Error> {
        draft.set("mask", "kind", "none");
        draft.set_array("psf", &[8, 8], &(0..64).map(|i| (i % 7) as f32).collect::<Vec<_>>());
        Ok(())
    }

    #[test]
    fn the_bundle_grows_beside_its_place_and_takes_it_as_a_whole() {
        let parent = tempfile::tempdir().unwrap();
        let dir = parent.path().join("bench");
        let window = Window::new(Size::new(16, 16), [0, 0], Size::new(16, 16), 2).unwrap();
        let readout = Some(Readout { channels: 1, window });
        let own = Workspace::open(&dir, readout, None).unwrap();
        assert_eq!(own.parts().missing().collect::<Vec<_>>(), [Step::Dark, Step::Mask, Step::Psf]);
        assert!(!own.work().exists(), "nothing is written before a result is kept");
        own.change(fill).unwrap();
        assert!(own.finish().is_err() && !dir.exists());
        // a setup that is started again goes on
        let own = Workspace::open(&dir, readout, None).unwrap();
        assert_eq!(own.parts().missing().collect::<Vec<_>>(), [Step::Mask, Step::Psf]);
        own.change(complete).unwrap();
        let bundle = own.finish().unwrap();
        assert_eq!(
            (bundle.name.as_str(), bundle.sensor.size),
            ("bench", Size::new(8, 8)),
            "the board's part of the frame"
        );
        assert!(!own.work().exists());

        // another round begins with the bundle that is there, which stays as it is until the end
        fs::write(dir.join("notes.txt"), "mine").unwrap();
        let again = Workspace::open(&dir, readout, None).unwrap();
        assert_eq!(again.parts().missing().count(), 0);
        again
            .change(|draft| {
                draft.set("noise", "read", 0.004);
                Ok(())
            })
            .unwrap();
        assert_eq!(Bundle::load(&dir).unwrap().digest, bundle.digest);
        let changed = again.finish().unwrap();
        assert_ne!(changed.digest, bundle.digest);
        assert_eq!(fs::read_to_string(dir.join("notes.txt")).unwrap(), "mine");
        assert_eq!(Bundle::load(&parent.path().join("bench.previous")).unwrap().digest, bundle.digest);

        // a power cut between the two renames of a file system that cannot exchange names
        fs::remove_dir_all(parent.path().join("bench.previous")).unwrap();
        fs::rename(&dir, parent.path().join("bench.previous")).unwrap();
        assert_eq!(Workspace::open(&dir, readout, None).unwrap().bundle().unwrap().digest, changed.digest);
    }
}
