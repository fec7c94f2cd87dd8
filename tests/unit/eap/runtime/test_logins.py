from __future__ import annotations

from eap.runtime.logins import FREE_FAILURES, LoginGuard


def fail(guard: LoginGuard, number: int, user: str, host: str, now_s: float = 0.0) -> None:
    for _ in range(number):
        guard.fail(user, host, now_s)


def test_login_guard_locks_user_at_the_host_for_ever_longer_times():
    guard = LoginGuard()
    fail(guard, FREE_FAILURES - 1, "otto", "a")
    assert guard.locked_s("otto", "a", 0.0) == 0
    fail(guard, 1, "otto", "a")
    assert guard.locked_s("otto", "a", 0.0) == 30
    assert guard.locked_s("otto", "b", 0.0) == 0
    assert guard.locked_s("elsa", "a", 0.0) == 0
    assert guard.locked_s("otto", "a", 30.0) == 0
    fail(guard, 1, "otto", "a", 30.0)
    assert guard.locked_s("otto", "a", 30.0) == 60
    fail(guard, 9, "otto", "a", 40.0)
    assert guard.locked_s("otto", "a", 40.0) == 900


def test_login_guard_locks_a_host_that_tries_many_users_and_a_user_that_many_hosts_try():
    guard = LoginGuard()
    for number in range(20):
        guard.fail(f"user{number}", "a", 0.0)
    assert guard.locked_s("elsa", "a", 0.0) > 0
    for number in range(100):
        guard.fail("otto", f"host{number}", 0.0)
    assert guard.locked_s("otto", "another", 0.0) > 0
    assert guard.locked_s("vera", "another", 0.0) == 0


def test_login_guard_forgets_after_a_right_password_and_after_an_hour():
    guard = LoginGuard()
    fail(guard, FREE_FAILURES, "otto", "a")
    guard.succeed("otto", "a")
    assert guard.locked_s("otto", "a", 0.0) == 0
    fail(guard, FREE_FAILURES - 1, "elsa", "a")
    assert guard.fail("elsa", "a", 9999.0) == 1


def test_login_guard_is_bounded():
    guard = LoginGuard()
    for number in range(5000):
        guard.fail(f"user{number}", f"host{number}", 0.0)
    assert len(guard._failures) == 4096
