use super::{Color, Stokes, Texture, polarized, ramp};

type Vec3 = [f32; 3];

/// Refractive index of lacquer and glass.
const INDEX: f32 = 1.5;
/// The eye, and the directions right, up and forward of its image.
const EYE: Vec3 = [0.0, 1.45, 4.6];
const UP: Vec3 = [0.0, 0.9701, -0.2425];
const FORWARD: Vec3 = [0.0, -0.2425, -0.9701];
/// Half the image is as wide as this at distance 1.
const FIELD: f32 = 0.36;
/// Towards the lamp.
const LAMP: Vec3 = [-0.48, 0.74, 0.47];
/// Radiance to sensor units.
const EXPOSURE: f32 = 1.55;

struct Ball {
    centre: Vec3,
    radius: f32,
    albedo: Vec3,
    /// 0 plain, 1 striped, 2 marbled.
    pattern: u8,
}

/// Glossy balls on a polished board: light that dielectrics reflect is polarized across the plane of incidence, wholly at
/// Brewster's angle; light that comes back out of their colour a little, within that plane.
pub(super) struct Spheres {
    balls: [Ball; 6],
    grain: Texture,
    marble: Texture,
    spin: f32,
}

impl Spheres {
    pub(super) fn at(seed: u64, time: f32) -> Self {
        let roll = 0.22 * (0.8 * time).sin();
        let hop = 0.16 * (1.7 * time).sin().powi(2);
        let ball = |x: f32, lift: f32, z: f32, radius: f32, albedo: Vec3, pattern| Ball {
            centre: [x, radius + lift, z],
            radius,
            albedo,
            pattern,
        };
        Self {
            balls: [
                ball(-0.72 + 0.4 * roll, 0.0, -0.15, 0.62, [0.035, 0.037, 0.045], 0),
                ball(0.52 - 0.3 * roll, 0.0, -0.45, 0.70, [0.62, 0.10, 0.07], 0),
                ball(0.18 + roll, 0.0, 0.85, 0.34, [0.80, 0.74, 0.62], 1),
                ball(1.05, hop, 0.55, 0.33, [0.08, 0.26, 0.42], 2),
                ball(-0.48, 0.6 * hop, 1.15, 0.22, [0.90, 0.55, 0.10], 0),
                ball(-1.18, 0.0, 0.75, 0.25, [0.12, 0.34, 0.13], 2),
            ],
            grain: Texture::new(seed, 30),
            marble: Texture::new(seed, 31),
            spin: 3.0 * roll,
        }
    }

    pub(super) fn stokes(&self, [u, v]: [f32; 2]) -> Color {
        let (x, y) = (u * FIELD, v * FIELD);
        let ray = unit(std::array::from_fn(|k| FORWARD[k] + y * UP[k] + if k == 0 { x } else { 0.0 }));
        let Some(hit) = self.hit(EYE, ray) else {
            return self.surroundings(ray).map(|s0| [s0 * EXPOSURE, 0.0, 0.0]);
        };
        let cos = -dot(ray, hit.normal);
        let mirror: Vec3 = std::array::from_fn(|k| ray[k] + 2.0 * cos * hit.normal[k]);
        let reflected = self.radiance(hit.place, mirror);
        let (rs, rp) = fresnel(cos);
        let depth = body_dolp(cos) * (1.0 - hit.rough);
        // in the image: across the plane of incidence for the mirror image, within it for light from the body
        let side = cross(ray, hit.normal);
        let across = [side[0], dot(side, UP)];
        let within = [-across[1], across[0]];
        let body = self.body(&hit);
        std::array::from_fn(|c| {
            let gloss = 0.5 * (rs + rp) * reflected[c] * (1.0 - 0.6 * hit.rough);
            let dolp = (rs - rp) / (rs + rp).max(1e-6) * (1.0 - hit.rough);
            let surface = polarized(gloss * EXPOSURE, dolp, across);
            let inner = polarized(body[c] * (1.0 - 0.5 * (rs + rp)) * EXPOSURE, depth, within);
            let sum: Stokes = std::array::from_fn(|k| surface[k] + inner[k]);
            // like film, the sensor's exposure is chosen so that only lamps come near full scale
            let keep = 1.0 / (1.0 + 0.18 * sum[0].powi(2));
            sum.map(|k| k * keep)
        })
    }

    /// Unpolarized radiance along a ray: what a mirror image shows.
    fn radiance(&self, from: Vec3, ray: Vec3) -> Vec3 {
        match self.hit(from, ray) {
            Some(hit) => {
                let (rs, rp) = fresnel(-dot(ray, hit.normal));
                let cos = -dot(ray, hit.normal);
                let mirror: Vec3 = std::array::from_fn(|k| ray[k] + 2.0 * cos * hit.normal[k]);
                let sky = self.surroundings(mirror);
                let body = self.body(&hit);
                std::array::from_fn(|k| body[k] + 0.5 * (rs + rp) * sky[k])
            }
            None => self.surroundings(ray),
        }
    }

    /// A studio: dim walls, a bright ceiling, two soft boxes with crossbars.
    fn surroundings(&self, ray: Vec3) -> Vec3 {
        let [x, y, z] = ray;
        let height = ramp(-0.2, 0.9, y);
        let wall = 0.30 + 0.10 * self.grain.fractal(7.0 * x / (z.abs() + 0.3), 7.0 * y / (z.abs() + 0.3), 4);
        let bands = 1.0 + 0.18 * (26.0 * x.atan2(-z)).sin().signum() * ramp(0.25, 0.05, y.abs());
        let mut light = wall * bands + 0.55 * height;
        for (towards, half) in [(LAMP, [0.30, 0.24]), ([0.78, 0.45, 0.43], [0.13, 0.34])] {
            let forward = unit(towards);
            let right = unit(cross([0.0, 1.0, 0.0], forward));
            let up = cross(forward, right);
            let depth = dot(ray, forward);
            if depth > 0.1 {
                let (a, b) = (dot(ray, right) / depth, dot(ray, up) / depth);
                let inside = ramp(0.015, -0.015, (a.abs() - half[0]).max(b.abs() - half[1]));
                let bars = 1.0 - ramp(0.02, 0.012, a.abs().min(b.abs()));
                light += 7.0 * inside * bars;
            }
        }
        [light, light * 0.99, light * 0.97]
    }

    /// Light that leaves the colour under the surface, before the surface takes its share.
    fn body(&self, hit: &Hit) -> Vec3 {
        let lamp = unit(LAMP);
        let direct = dot(hit.normal, lamp).max(0.0) * self.lit(hit.place, lamp);
        let ceiling = 0.5 + 0.5 * hit.normal[1];
        let light = 0.72 * direct + 0.38 * ceiling * self.open(hit.place, hit.normal);
        hit.albedo.map(|a| a * light)
    }

    /// Share of the lamp seen from a place, soft at the edge of shadows.
    fn lit(&self, place: Vec3, lamp: Vec3) -> f32 {
        self.balls.iter().fold(1.0f32, |share, ball| {
            let to = sub(ball.centre, place);
            let along = dot(to, lamp);
            if along <= 0.02 || dot(to, to) < 1.001 * ball.radius * ball.radius {
                return share;
            }
            let miss = (dot(to, to) - along * along).max(0.0).sqrt();
            share.min(ramp(-0.16 * along, 0.16 * along, miss - ball.radius))
        })
    }

    /// Share of the ceiling that the balls leave open above a place.
    fn open(&self, place: Vec3, normal: Vec3) -> f32 {
        let floor = 1.0 - 0.55 * (1.0 - normal[1]) * (-(place[1] / 0.25)).exp();
        self.balls.iter().fold(floor, |open, ball| {
            let to = sub(ball.centre, place);
            let far = dot(to, to).sqrt();
            if far < 1.001 * ball.radius {
                return open;
            }
            let cap = (ball.radius / far).powi(2) * (dot(to, normal) / far).max(0.0);
            open * (1.0 - 0.9 * cap)
        })
    }

    fn hit(&self, from: Vec3, ray: Vec3) -> Option<Hit> {
        let mut nearest: Option<(f32, &Ball)> = None;
        for ball in &self.balls {
            let to = sub(from, ball.centre);
            let b = dot(to, ray);
            let root = b * b - dot(to, to) + ball.radius * ball.radius;
            if root > 0.0 {
                let t = -b - root.sqrt();
                if t > 1e-3 && nearest.is_none_or(|(best, _)| t < best) {
                    nearest = Some((t, ball));
                }
            }
        }
        if let Some((t, ball)) = nearest {
            let place: Vec3 = std::array::from_fn(|k| from[k] + t * ray[k]);
            let normal = sub(place, ball.centre).map(|k| k / ball.radius);
            return Some(Hit { place, normal, albedo: self.paint(ball, normal), rough: 0.02 });
        }
        let t = -from[1] / ray[1];
        if ray[1] >= 0.0 || t < 1e-3 || from[2] + t * ray[2] < -3.2 {
            return None;
        }
        let place: Vec3 = std::array::from_fn(|k| from[k] + t * ray[k]);
        Some(self.board(place))
    }

    fn paint(&self, ball: &Ball, [x, y, z]: Vec3) -> Vec3 {
        let (sin, cos) = (self.spin / ball.radius * 0.3).sin_cos();
        let [x, y] = [cos * x - sin * y, sin * x + cos * y];
        match ball.pattern {
            1 => {
                let stripe = ramp(-0.03, 0.03, 0.36 - (0.8 * x + 0.6 * y).abs());
                let blue = [0.06, 0.10, 0.36];
                std::array::from_fn(|k| ball.albedo[k] + stripe * (blue[k] - ball.albedo[k]))
            }
            2 => {
                let vein = self.marble.fractal(2.3 * x + 5.0 * ball.radius, 2.3 * y + 1.9 * z, 4);
                ball.albedo.map(|a| a + 0.55 * ramp(0.16, 0.0, vein.abs()) * (0.9 - a))
            }
            _ => ball.albedo.map(|a| a * (1.0 + 0.10 * self.marble.fractal(5.0 * x, 5.0 * y + 3.0 * z, 3))),
        }
    }

    /// The board: inlaid squares of two woods under lacquer.
    fn board(&self, place: Vec3) -> Hit {
        let [x, _, z] = place;
        let (i, j) = ((x / 0.46).floor(), (z / 0.46).floor());
        let dark = (i + j).rem_euclid(2.0) > 0.5;
        let (a, b) = if dark { (x, z) } else { (z, x) };
        let tone = self.marble.cell(i as i32, j as i32);
        let rings = self.grain.fractal(1.5 * a + 9.0 * tone, 17.0 * b, 3);
        let pores = ramp(0.35, 0.6, self.grain.smooth(9.0 * a, 90.0 * b));
        let wood = if dark { [0.17, 0.085, 0.045] } else { [0.66, 0.47, 0.27] };
        let shade = (1.0 + 0.16 * tone + 0.34 * rings) * (1.0 - 0.30 * pores);
        // lacquer is never quite flat
        let wave = 0.012;
        let nx = wave * self.marble.smooth(3.0 * x, 3.0 * z);
        let nz = wave * self.marble.smooth(3.0 * x + 50.0, 3.0 * z);
        Hit { place, normal: unit([nx, 1.0, nz]), albedo: wood.map(|w| w * shade), rough: 0.12 }
    }
}

struct Hit {
    place: Vec3,
    normal: Vec3,
    albedo: Vec3,
    /// Share of the mirror image that is scattered and loses its polarization.
    rough: f32,
}

/// Reflectance across and within the plane of incidence (Fresnel), from air at angle `acos(cos)`.
fn fresnel(cos: f32) -> (f32, f32) {
    let cos = cos.clamp(0.0, 1.0);
    let inner = (1.0 - (1.0 - cos * cos) / (INDEX * INDEX)).sqrt();
    let s = (cos - INDEX * inner) / (cos + INDEX * inner);
    let p = (INDEX * cos - inner) / (INDEX * cos + inner);
    (s * s, p * p)
}

/// Degree of polarization of light that leaves a dielectric's body (Atkinson and Hancock 2006, equation 6).
fn body_dolp(cos: f32) -> f32 {
    let cos = cos.clamp(0.0, 1.0);
    let sin2 = 1.0 - cos * cos;
    let (n2, minus, plus) = (INDEX * INDEX, INDEX - 1.0 / INDEX, INDEX + 1.0 / INDEX);
    minus * minus * sin2 / (2.0 + 2.0 * n2 - plus * plus * sin2 + 4.0 * cos * (n2 - sin2).sqrt())
}

fn dot(a: Vec3, b: Vec3) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

fn sub(a: Vec3, b: Vec3) -> Vec3 {
    std::array::from_fn(|k| a[k] - b[k])
}

fn cross(a: Vec3, b: Vec3) -> Vec3 {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn unit(a: Vec3) -> Vec3 {
    let norm = dot(a, a).sqrt();
    a.map(|k| k / norm)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn brewster_and_grazing_angles() {
        let (s, p) = fresnel(INDEX.atan().cos());
        assert!(p < 1e-6 && s > 0.1);
        let (s, p) = fresnel(1.0);
        assert!((s - 0.04).abs() < 1e-4 && (p - 0.04).abs() < 1e-4);
        assert!(body_dolp(1.0) < 1e-6 && (0.3..0.45).contains(&body_dolp(0.0)));
    }

    #[test]
    fn the_table_reflects_horizontal_polarization() {
        let [s0, s1, s2] = Spheres::at(1, 0.0).stokes([0.0, -0.95])[1];
        assert!(s1 > 0.02 * s0 && s2.abs() < 0.5 * s1, "{s0} {s1} {s2}");
    }
}
