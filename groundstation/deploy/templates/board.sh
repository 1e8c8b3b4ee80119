#!/bin/sh
# What `groundstation deploy` does on a robot's board: put the parts that came into place, each whole or not at all.
# Usage: sh board.sh HOME RESTART(yes|no|force); armed.sh stands before it. In HOME/incoming: manifest, and of software/ keys/ experiment.toml init.args what has
# changed. Prints "key=value" lines for the station.
set -eu
umask 077
home=$1
restart=$2
in=$home/incoming
cd "$home"

# A restart disarms the robot. Asked at first, and again when it is due: an installation takes minutes.
refuse_if_armed() {
    does=$([ "$restart" != yes ] || armed)
    if [ -n "$does" ]; then
        echo "its agent is $does now: the service was not restarted; deploy again when it is DISARMED" >&2
        exit 3
    fi
}
refuse_if_armed

if [ -d "$in/software" ]; then
    venv=venvs/$(sed -n 's/^software //p' "$in/manifest")
    if [ ! -f "$venv/complete" ]; then
        rm -rf "$venv"
        mkdir -p venvs
        python3 -m venv "$venv"
        "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-index --find-links "$in/software" shoal
        : >"$venv/complete"
    fi
    before=$(readlink venv || true)
    ln -sfn "$venv" venv.next
    mv -T venv.next venv
    for old in venvs/*; do # the one before stays, to go back to by hand
        [ "$old" = "$venv" ] || [ "$old" = "$before" ] || rm -rf "$old"
    done
fi

if [ -d "$in/keys" ]; then
    chmod -R u=rwX,go= "$in/keys"
    rm -rf keys.before
    [ ! -d keys ] || mv keys keys.before
    mv "$in/keys" keys
    rm -rf keys.before
fi

[ ! -f "$in/experiment.toml" ] || mv "$in/experiment.toml" experiment.toml

if [ -f "$in/init.args" ]; then
    set --
    while IFS= read -r argument; do set -- "$@" "$argument"; done <"$in/init.args"
    [ ! -f agent.toml ] || cp -p agent.toml agent.toml.before
    venv/bin/robot-agent init "$@" --out "$in/agent.toml" >/dev/null # it names itself in its text
    mv "$in/agent.toml" agent.toml
fi

if [ -d /run/systemd/system ]; then
    sudo=
    [ "$(id -u)" = 0 ] || sudo="sudo -n"
    unit=/etc/systemd/system/shoal-agent.service
    venv/bin/robot-agent unit --home "$home" --user "$(id -un)" >unit.next
    if ! cmp -s unit.next "$unit"; then
        $sudo install -m 644 unit.next "$unit"
        $sudo systemctl daemon-reload
        $sudo systemctl enable --quiet shoal-agent.service
    fi
    rm -f unit.next
    kernels=/var/lib/shoal-agent/kernels # as in the unit: compiled now, so that the agent starts at once
    $sudo install -d -m 700 -o "$(id -un)" /var/lib/shoal-agent "$kernels"
    NUMBA_CACHE_DIR=$kernels venv/bin/robot-agent compile >/dev/null
    refuse_if_armed
    if [ "$restart" = no ]; then
        service="$(systemctl is-active shoal-agent.service || true), to be restarted"
    else
        $sudo systemctl restart --no-block shoal-agent.service
        for _ in 1 2 3 4 5 6 7 8 9 10; do # an agent that fails at its start is not told by the restart itself
            sleep 1
            service=$(systemctl is-active shoal-agent.service || true)
            [ "$service" = activating ] || [ "$service" = deactivating ] || break
        done
    fi
else
    service="no systemd here"
fi

# What is installed and does not run yet: the next deployment restarts it though nothing travels then.
[ "$restart" != no ] || echo "restart due" >>"$in/manifest"
mv "$in/manifest" manifest
rm -rf "$in"
echo "version=$(venv/bin/python -c 'from importlib.metadata import version; print(version("shoal"))')"
echo "service=$service"
