//! Places: which connections are served when there are more than places.
//!
//! Whoever has the token, or needs none, and is being answered keeps its place. The others make room for newer ones: first those without the
//! token, then those that ask for nothing. One address cannot take more than a share of the places without the token.

use std::net::IpAddr;
use std::rc::{Rc, Weak};

use super::connection::Connection;

/// Part of the places that the connections of one address may take without the token: 1/4.
const UNPROVEN: usize = 4;

/// A place that is taken. It is free again when this is dropped.
pub(super) type Place = Rc<Connection>;

/// Places of the connections that are served.
#[derive(Debug)]
pub(super) struct Places {
    most: usize,
    /// Whether a token is needed.
    token: bool,
    /// Oldest first.
    taken: Vec<Weak<Connection>>,
}

impl Places {
    pub(super) fn new(most: usize, token: bool) -> Self {
        Self { most, token, taken: Vec::new() }
    }

    /// Gives the connection a place, perhaps that of another one, which is told to end; none when all of them are in use.
    pub(super) fn take(&mut self, connection: &Connection) -> Option<Place> {
        if !self.token {
            connection.prove();
        }
        self.taken.retain(|place| place.strong_count() > 0);
        let taken: Vec<Place> = self.taken.iter().filter_map(Weak::upgrade).collect();
        let unproven = |place: &&Place| !place.is_proven();
        let share = (self.most / UNPROVEN).max(2);
        let own: Vec<&Place> =
            taken.iter().filter(unproven).filter(|place| place.remote == connection.remote).collect();
        let leaves = if own.len() >= share {
            own.first().copied()
        } else if taken.len() >= self.most {
            let crowd = taken.iter().find(unproven);
            Some(crowd.or_else(|| taken.iter().find(|place| place.is_idle()))?)
        } else {
            None
        };
        if let Some(leaves) = leaves {
            leaves.dismiss();
            self.taken.retain(|place| !std::ptr::eq(place.as_ptr(), Rc::as_ptr(leaves)));
        }
        let place = Rc::new(connection.clone());
        self.taken.push(Rc::downgrade(&place));
        Some(place)
    }
}

/// Address that shares are counted by: the network of an IPv6 client, which has any number of addresses.
pub(super) fn neighbourhood(address: IpAddr) -> IpAddr {
    match address.to_canonical() {
        IpAddr::V6(v6) => IpAddr::V6((u128::from(v6) & !u128::from(u64::MAX)).into()),
        v4 => v4,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn client(remote: &str) -> Connection {
        Connection::new("127.0.0.1:80".parse().unwrap(), neighbourhood(remote.parse().unwrap()), None)
    }

    #[test]
    fn clients_without_the_token_lock_nobody_out() {
        let mut places = Places::new(8, true);
        let mut watch = || {
            let place = places.take(&client("10.0.0.1")).unwrap();
            place.prove();
            place.begin();
            place
        };
        let watchers: Vec<_> = (0..5).map(|_| watch()).collect();
        // one address takes two places at a time, however often it comes
        let crowd: Vec<_> = (0..40).map(|_| places.take(&client("10.0.0.2")).unwrap()).collect();
        assert_eq!(places.taken.len(), 7);
        // and many addresses make room for each other
        let many: Vec<_> = (0..40).map(|n| places.take(&client(&format!("10.0.1.{n}"))).unwrap()).collect();
        assert_eq!(places.taken.len(), 8);
        places.take(&client("10.0.0.3")).unwrap();
        assert!(watchers.iter().all(|place| places.taken.iter().any(|t| std::ptr::eq(t.as_ptr(), Rc::as_ptr(place)))));
        drop((crowd, many));
    }

    #[test]
    fn idle_clients_make_room_and_watchers_do_not() {
        let mut places = Places::new(3, false);
        let held: Vec<_> = (0..3).map(|_| places.take(&client("::1")).unwrap()).collect();
        held[0].begin();
        held[2].begin();
        let next = places.take(&client("::1")).unwrap();
        next.begin();
        assert!(places.take(&client("::1")).is_none(), "all are being answered");
        held[2].end();
        assert!(places.take(&client("::1")).is_some());
        drop(held);
    }

    #[test]
    fn addresses_of_one_network_are_neighbours() {
        let of = |text: &str| neighbourhood(text.parse().unwrap());
        assert_eq!(of("2001:db8::1"), of("2001:db8::2:3:4:5"));
        assert_ne!(of("2001:db8::1"), of("2001:db8:0:1::1"));
        assert_eq!(of("::ffff:10.0.0.1"), of("10.0.0.1"));
        assert_ne!(of("10.0.0.1"), of("10.0.0.2"));
    }
}
