# Completion of lathe for bash. No blank follows a node or a parameter: its name or value is yet to be typed.
_lathe_complete() {
    local IFS=$'\n' each kind value
    COMPREPLY=()
    for each in $(COMP_WORDS="${COMP_WORDS[*]}" COMP_CWORD=$COMP_CWORD _LATHE_COMPLETE=bash_complete \
        "${1/#\~/$HOME}" 2>/dev/null); do
        IFS=',' read -r kind value <<< "$each"
        case $kind in
            dir) compopt -o dirnames ;;
            file) compopt -o default ;;
            plain) COMPREPLY+=("$value") ;;
        esac
    done
    if [[ ${#COMPREPLY[@]} -eq 1 && ${COMPREPLY[0]} == *[.=] ]]; then compopt -o nospace; fi
}
complete -o nosort -F _lathe_complete lathe
