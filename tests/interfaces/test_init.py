from fibaction import action_files, interfaces


def test_the_package_exports_the_error_that_its_users_catch() -> None:
    assert interfaces.InterfaceError is action_files.InterfaceError
